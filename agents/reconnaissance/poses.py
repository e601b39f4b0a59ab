"""Where a vehicle was in the last seconds: what a camera shows is placed by the pose of the instant of its picture.

Between two ticks a cubic (Hermite) leads from pose to pose, with the speeds at both: exact where position and attitude change
with a constant acceleration, about one axis. Along a straight line, and by an even turn, a quadrotor that begins to dart would
be off by a degree and more half-way between ticks of 0.1 s, and so would be what it sees by half a metre at 20 m.
"""

import math
from collections import deque

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import Quaternion, product
from vcmvsp.cosim.types import Vec3, VehicleState

KEPT_NS = seconds_to_ns(10.0)
GAP = 1.5  # periods between poses; longer gaps are not interpolated


class Poses:
    """Of one vehicle; ``period_s``: from tick to tick."""

    def __init__(self, period_s: float) -> None:
        self._gap_ns = seconds_to_ns(GAP * period_s)
        self._states: deque[tuple[int, VehicleState]] = deque()

    def add(self, obs: Observation) -> None:
        """Take in the pose at a tick; one that is not later than the last is that one."""
        if self._states and obs.time_ns <= self._states[-1][0]:
            return
        self._states.append((obs.time_ns, obs.state))
        while self._states[0][0] < obs.time_ns - KEPT_NS:
            self._states.popleft()

    def at(self, time_ns: int) -> VehicleState | None:
        """Position and attitude then; None: not known."""
        after: tuple[int, VehicleState] | None = None
        for before in reversed(self._states):
            if before[0] <= time_ns:
                return _between(before, after, time_ns, self._gap_ns)
            after = before
        return None


def _between(
    before: tuple[int, VehicleState], after: tuple[int, VehicleState] | None, time_ns: int, gap_ns: int
) -> VehicleState | None:
    (start_ns, start), (end_ns, end) = before, after or before
    if time_ns == start_ns:
        return start
    if after is None or end_ns - start_ns > gap_ns:
        return None
    period_s = (end_ns - start_ns) / 1e9
    share = (time_ns - start_ns) / (end_ns - start_ns)
    way: Vec3 = tuple(b - a for a, b in zip(start.position, end.position, strict=True))  # type: ignore[assignment]
    gone = _cubic(way, start.velocity, end.velocity, period_s, share)
    w, x, y, z = start.attitude
    turn = _rotation_vector(product((w, -x, -y, -z), end.attitude))
    # q = q0 exp(r) turns at the rate J(r) r', J the right Jacobian, of which the inverse is about 1 + r/2 x
    (a, b, c), (p, q, r) = turn, end.angular_velocity
    rate = p + 0.5 * (b * r - c * q), q + 0.5 * (c * p - a * r), r + 0.5 * (a * q - b * p)
    turned = _cubic(turn, start.angular_velocity, rate, period_s, share)
    position: Vec3 = tuple(p + d for p, d in zip(start.position, gone, strict=True))  # type: ignore[assignment]
    return VehicleState(position=position, attitude=product(start.attitude, _quaternion(turned)))


def _cubic(way: Vec3, begin: Vec3, end: Vec3, period_s: float, s: float) -> Vec3:
    """Cubic Hermite interpolation from 0 to ``way`` with end speeds, at a share ``s`` of the period."""
    x, y, z = (
        (3.0 - 2.0 * s) * s * s * w + period_s * s * (1.0 - s) * ((1.0 - s) * b - s * e)
        for w, b, e in zip(way, begin, end, strict=True)
    )
    return x, y, z


def _rotation_vector(turn: Quaternion) -> Vec3:
    """Axis times angle, rad, of the shorter rotation; q and -q are equivalent."""
    w, *axis = turn
    sine = math.hypot(*axis)
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine if sine > 1e-9 else 2.0, w)
    x, y, z = (scale * each for each in axis)
    return x, y, z


def _quaternion(rotation: Vec3) -> Quaternion:
    angle = math.hypot(*rotation)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    x, y, z = (scale * each for each in rotation)
    return math.cos(0.5 * angle), x, y, z
