"""Putting an obstacle somewhere else: by numbers, or by dragging it."""

from collections.abc import Callable

import numpy as np
import viser

from vcmvsp.cosim.frames import quaternion_from_yaw, yaw_of
from vcmvsp.cosim.view.messages import Move, Order, Scenery
from vcmvsp.cosim.view.page.inputs import picked, write
from vcmvsp.cosim.view.page.state import Known


class Mover:
    """Made in the context of its container; only for a scenery with obstacles that may be moved."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery, give: Callable[[Order], None]) -> None:
        self._give = give
        self._pose = {each.name: each.pose for each in scenery.obstacles if each.may_be_moved}
        gui = server.gui
        self._which = gui.add_dropdown("Obstacle", list(self._pose))
        self._x = gui.add_number("x [m]", 0.0, step=0.1)
        self._y = gui.add_number("y [m]", 0.0, step=0.1)
        self._yaw = gui.add_number("yaw [rad]", 0.0, step=0.05)
        self._move = gui.add_button("Move obstacle")
        self._dragged = gui.add_checkbox("Drag", initial_value=False)
        self._gizmo = server.scene.add_transform_controls(
            "/gizmo", scale=1.5, active_axes=(True, True, False), disable_rotations=False, visible=False
        )
        self._which.on_update(lambda _: self._begin())
        self._move.on_click(lambda _: self._send())
        self._dragged.on_update(lambda _: self._begin())
        self._gizmo.on_update(self._drag)
        self._begin()

    def draw(self, known: Known) -> None:
        """Learn where the obstacles are, and whether the run is over."""
        for name, pose in known.obstacles.items():
            if name in self._pose:
                self._pose[name] = pose
        over = bool(known.pace.over)
        self._move.disabled = self._dragged.disabled = over
        if over:
            self._gizmo.visible = False

    def _begin(self) -> None:
        """Start from where the obstacle is."""
        x, y, z, yaw = self._pose[picked(self._which)]
        self._write(x, y, yaw)
        self._gizmo.position, self._gizmo.wxyz = (x, y, z), quaternion_from_yaw(yaw)
        self._gizmo.visible = self._dragged.value and not self._dragged.disabled

    def _drag(self, event: viser.TransformControlsEvent) -> None:
        w, x, y, z = np.asarray(event.target.wxyz, float).tolist()
        self._write(float(event.target.position[0]), float(event.target.position[1]), yaw_of((w, x, y, z)))
        if event.phase == "end":
            self._send()

    def _write(self, x: float, y: float, yaw: float) -> None:
        for part, number in ((self._x, x), (self._y, y), (self._yaw, yaw)):
            write(part, round(number, 3))

    def _send(self) -> None:
        self._give(Move(obstacle=picked(self._which), position=(self._x.value, self._y.value), yaw=self._yaw.value))
