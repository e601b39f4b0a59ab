"""What is drawn about the vehicles: where they came from, the places they mean to keep, and where they were measured to be."""

import numpy as np
import viser

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.batches import Batch, Segments
from vcmvsp.cosim.view.page.formation_slots import places_of
from vcmvsp.cosim.view.page.state import Known
from vcmvsp.cosim.view.page.style import TINY, Every, box, colors_of, disc, turned

SEGMENTS, LONGEST, SHORTEST = 4000, 150, 20
"""Of all trails together, and of each of them."""
TRAIL_NS = 30 * SECOND_NS  # which a trail reaches back, unless the run is so fast that it is more
LEAST_M = 0.03  # radius of the mark of an exact position
OVER_M = 0.02  # above the floor, so that it is seen


class Trails:
    """Where the vehicles were lately."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        count = len(scenery.vehicles)
        self._steps = min(max(SEGMENTS // max(count, 1), SHORTEST), LONGEST)
        self._colors = colors_of(count)
        # A slow fade to the floor's colour says which end is old.
        share = np.linspace(0.25, 1.0, self._steps + 1)[None, :, None]
        shades = (235.0 + share * (self._colors[:, None] - 235.0)).astype(np.uint8)
        self._lines = Segments(server, "/trails", _pairs(shades), 2.0)
        self._places = np.empty((count, 0, 3))
        self._next_ns, self._times_back = 0, 0
        self._often = Every(0.25)
        self._new = False

    def sample(self, known: Known) -> None:
        """Take in where the vehicles are, if it is time."""
        if known.times_back != self._times_back:
            self._times_back, self._next_ns = known.times_back, 0
            self._places = self._places[:, :0]
        if known.time_ns < self._next_ns or not np.isfinite(known.position).any():
            return
        self._next_ns = known.time_ns + TRAIL_NS // self._steps
        self._places = np.concatenate([self._places[:, -self._steps :], known.position[:, None]], axis=1)
        self._new = True

    def draw(self, now_s: float) -> None:
        """Draw them, if they are longer than they were."""
        if self._new and self._often.due(now_s):
            self._new = False
            missing = self._steps + 1 - self._places.shape[1]
            padded = np.concatenate([np.repeat(self._places[:, :1], missing, axis=1), self._places], axis=1)
            pairs = _pairs(padded)
            unknown = ~np.isfinite(pairs).all(axis=(1, 2))
            pairs[unknown] = 0.0
            self._lines.put(pairs)

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        self._lines.show(visible)


class Ghosts:
    """The places that followers mean to keep: bodies that can be seen through, and lines to them."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._size = np.array([each.size for each in scenery.vehicles], float).reshape(-1, 3)
        colors = colors_of(len(self._size))
        self._bodies = Batch(server, "/places/bodies", box(), colors, opacity=0.3)
        self._lines = Segments(server, "/places/lines", np.repeat(colors[:, None], 2, axis=1), 1.5)

    def draw(self, known: Known) -> None:
        """Put them where they are."""
        places = places_of(known)
        position, yaw = np.zeros_like(self._size), np.zeros(len(self._size))
        scale = np.full_like(self._size, TINY)
        points = np.zeros((len(self._size), 2, 3))
        position[places.row], yaw[places.row] = places.place, places.yaw
        scale[places.row] = self._size[places.row]
        points[places.row] = np.stack([known.position[places.row], places.place], axis=1)
        self._bodies.put(position, turned(yaw), scale)
        self._lines.put(points)

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        self._bodies.show(visible)
        self._lines.show(visible)


class Fixes:
    """Where positioning systems say that vehicles are: a disc of one standard deviation on each, and what is seen of it."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        colors = colors_of(len(scenery.vehicles))
        self._discs = Batch(server, "/fixes", disc(), colors, opacity=0.35)
        self._flies = [each.flies for each in scenery.vehicles]
        self._often, self._any = Every(0.1), False

    def draw(self, known: Known, now_s: float) -> None:
        """Put them where they are."""
        if not (known.fixes or self._any) or not self._often.due(now_s):
            return
        self._any = bool(known.fixes)
        count = len(known.names)
        position, scale = np.zeros((count, 3)), np.full((count, 3), TINY)
        for name, fix in known.fixes.items():
            if (row := known.row.get(name)) is not None:
                position[row] = fix.position
                if not self._flies[row]:  # on the floor, whatever its height was measured to be
                    position[row, 2] = known.position[row, 2] + OVER_M
                scale[row] = (max(fix.sigma_m, LEAST_M), max(fix.sigma_m, LEAST_M), 1.0)
        self._discs.put(position, turned(np.zeros(count)), scale)

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        self._discs.show(visible)


def _pairs(points: Array) -> Array:
    """Chains of points, (n, k + 1, 3), as the pieces between them, (n * k, 2, 3)."""
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
