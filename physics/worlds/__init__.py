"""The worlds that a scenario can name: each has ``build() -> World``."""

from physics.worlds.corridor import Corridor
from physics.worlds.gates import Gates, GatesOffset
from physics.worlds.laboratory import Laboratory
from physics.worlds.listed import Boxes, Empty
from physics.worlds.pillar import Pillar
from physics.worlds.recreation import RecreationCentre
from physics.worlds.urban import Urban

__all__ = ["Boxes", "Corridor", "Empty", "Gates", "GatesOffset", "Laboratory", "Pillar", "RecreationCentre", "Urban"]
