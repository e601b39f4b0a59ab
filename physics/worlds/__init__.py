"""The worlds that a scenario can name: each has ``build() -> World``. Readers of files are in `physics.importers`."""

from vcmvsp.physics.worlds.boxes import Boxes, Empty
from vcmvsp.physics.worlds.laboratory import Laboratory
from vcmvsp.physics.worlds.obstacle_courses import Corridor, Gates, GatesOffset, Pillar
from vcmvsp.physics.worlds.recreation import RecreationCentre
from vcmvsp.physics.worlds.urban import Urban

__all__ = ["Boxes", "Corridor", "Empty", "Gates", "GatesOffset", "Laboratory", "Pillar", "RecreationCentre", "Urban"]
