"""The vehicles in the browser: their bodies and names, which one is chosen, and which ones are stopped."""

from collections.abc import Callable

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.batches import Batch, Segments
from vcmvsp.cosim.view.page.state import Known
from vcmvsp.cosim.view.page.style import (
    CHOSEN_RGB,
    STOPPED_RGB,
    TINY,
    WHITE,
    Every,
    box,
    colors_of,
    disc,
    nose,
    quadrotor,
    ring,
    rotated,
)

LABELS = 200  # vehicles; of more, the others' names are not written beside them
LABELS_AT_ONCE = 16  # are moved: each costs a message
ABOVE_M = 0.12  # a name over its body
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


class Vehicles:
    """All vehicles of a run, a few nodes together.

    Args:
        server: of the page.
        scenery: of the run.
        choose: called with the row of a vehicle that is clicked at.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery, choose: Callable[[int], None]) -> None:
        crafts = scenery.vehicles
        count = len(crafts)
        self._size = np.array([each.size for each in crafts], float).reshape(-1, 3)
        self._offset = np.array([each.offset for each in crafts], float).reshape(-1, 3)
        flies = np.array([each.flies for each in crafts], bool)
        colors = colors_of(count)
        self._rows = np.flatnonzero(~flies), np.flatnonzero(flies)
        shapes = ("ground", box()), ("air", quadrotor())
        self._bodies = [
            Batch(server, f"/vehicles/{name}", mesh, colors[rows], clicked=_clicked(rows, choose))
            for (name, mesh), rows in zip(shapes, self._rows, strict=True)
        ]
        self._noses = Batch(server, "/vehicles/noses", nose(), np.tile(np.array(WHITE, np.uint8), (count, 1)))
        self._stopped = Batch(server, "/stopped", disc(), np.tile(np.array(STOPPED_RGB, np.uint8), (count, 1)), opacity=0.45)
        air = self._rows[1]
        self._drops = Segments(server, "/heights", np.repeat(colors[air, None], 2, axis=1), 1.0)
        vertices, faces = ring()
        self._chosen = server.scene.add_mesh_simple(
            "/chosen", vertices, faces, color=CHOSEN_RGB, side="double", visible=False, cast_shadow=False
        )
        self._labels = [
            server.scene.add_label(f"/names/{each.name}", each.name, font_screen_scale=0.8, anchor="bottom-center")
            for each in crafts[:LABELS]
        ]
        self._label = 0
        self._slow = Every(0.1)

    def draw(self, known: Known, chosen: int, now_s: float) -> None:
        """Put all of them where they are."""
        if not len(self._size):
            return
        seen = np.isfinite(known.position).all(axis=1)
        centre = np.where(seen[:, None], known.position, 0.0) + rotated(known.attitude, self._offset)
        scale = np.where(seen[:, None], self._size, TINY)
        for rows, bodies in zip(self._rows, self._bodies, strict=True):
            bodies.put(centre[rows], known.attitude[rows], scale[rows])
        self._noses.put(centre, known.attitude, scale)
        top = centre[self._rows[1]]
        self._drops.put(np.stack([top, top * (1.0, 1.0, 0.0)], axis=1))
        floor = centre - np.column_stack([np.zeros_like(scale[:, :2]), 0.5 * self._size[:, 2]])
        reach = 0.5 * np.hypot(self._size[:, 0], self._size[:, 1])
        self._chosen.visible = bool(seen[chosen])
        self._chosen.position, self._chosen.scale = floor[chosen], 1.15 * float(reach[chosen])
        if self._slow.due(now_s):
            self._draw_stopped(known, floor, reach)
        self._draw_labels(centre)

    def name(self, visible: bool) -> None:
        """Let the names be seen, or not."""
        for each in self._labels:
            each.visible = visible

    def _draw_stopped(self, known: Known, floor: Array, reach: Array) -> None:
        """A red disc under each vehicle that the operator has stopped."""
        radius = np.full(len(reach), TINY)
        rows = [known.row[name] for name in known.halted if name in known.row]
        radius[rows] = 1.5 * reach[rows]
        upright = np.tile(UPRIGHT, (len(reach), 1))
        self._stopped.put(floor, upright, np.column_stack([radius, radius, np.ones(len(reach))]))

    def _draw_labels(self, centre: Array) -> None:
        """Move names along; of many vehicles some at a time, in turn."""
        for _ in range(min(LABELS_AT_ONCE, len(self._labels))):
            row = self._label = (self._label + 1) % len(self._labels)
            self._labels[row].position = centre[row] + (0.0, 0.0, 0.5 * float(self._size[row, 2]) + ABOVE_M)


def _clicked(rows: Array, choose: Callable[[int], None]) -> Callable[[int], None]:
    """What a click at one of these bodies does."""
    return lambda index: choose(int(rows[index]))
