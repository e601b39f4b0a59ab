"""Firmware of differential drives: set points of (v, w) that ramp towards commands.

Plain numbers in lists, and only rows with changing set points: such a row costs 0.5 us a cycle, a steady fleet costs nothing.
(NumPy is quicker from 25 such rows on, which saves 1 % of a step of a hundred robots.)
"""

from collections.abc import Sequence

from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.urdf import UrdfDrive


class Firmware:
    """Moves the set points of (v, w) of every robot towards its command, a cycle at a time."""

    def __init__(self, models: Sequence[DifferentialDrive | UrdfDrive]) -> None:
        self._models = models
        self._command = [(0.0, 0.0)] * len(models)
        self._set = [(0.0, 0.0)] * len(models)
        self._ramping: list[int] = []  # rows with set points away from the command

    def command(self, row: int, v: float, w: float) -> None:
        """Set the target of the set points, m/s and rad/s, within the greatest speeds."""
        max_v, max_w = self._models[row].max_speed, self._models[row].max_yaw_rate
        self._command[row] = max(-max_v, min(v, max_v)), max(-max_w, min(w, max_w))
        if row not in self._ramping:
            self._ramping.append(row)

    def cycle(self, dt: float) -> list[tuple[int, float, float]]:
        """One cycle of ``dt`` s: rows with changed set points, and these (v m/s, w rad/s)."""
        if not self._ramping:
            return []
        changed, ramping = [], []
        for row in self._ramping:
            model, (v, w), target = self._models[row], self._set[row], self._command[row]
            turn = model.yaw_accel * dt
            new = _towards(v, target[0], model.accel * dt, model.decel * dt), _towards(w, target[1], turn, turn)
            if new != (v, w):
                self._set[row] = new
                changed.append((row, *new))
            if new != target:
                ramping.append(row)
        self._ramping = ramping
        return changed


def _towards(speed: float, target: float, up: float, down: float) -> float:
    """The speed after a cycle: at most ``up`` away from standstill or ``down`` towards it, and never past standstill."""
    if speed * target < 0.0:
        target = 0.0
    change = target - speed
    most = down if abs(target) < abs(speed) else up
    return target if abs(change) <= most else speed + (most if change > 0.0 else -most)
