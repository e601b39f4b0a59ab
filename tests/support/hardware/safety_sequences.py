"""Rehearsals of the supervisors: a robot on the ground or in the air is driven through commands and faults, and checked.

Each fault lasts for some periods. The checks are written anew here, and shorter than in the product: limits on speed and
acceleration of commands; stops exactly for silent sources, for these causes and no others, with immediate braking; true
position within fence, floor and ceiling and clear of others at rest. A false pose makes the last of these impossible: it is
checked again once the robot is at rest and its pose is true.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from tests.hardware.safety.test_ground_laws import FENCES, RADIUS, STARTS, ideal, ramping, room
from tests.support.hardware.supervised_flight import flight_of, safety_of
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.safety.aerial_supervisor import AerialSupervisor
from vcmvsp.hardware.safety.obstacles import RETURN_MPS, Others
from vcmvsp.hardware.safety.supervisor import Cause, GroundSupervisor, LastReceived, Limits

SECOND = 10**9
PERIOD_NS = SECOND // 10
SEPARATION, OTHER, FLOOR, CEILING = 0.3, 0.2, 0.5, 2.5
SOURCES = ("operator", "command", "positioning", "federation")
TIME_OUTS = {"operator_s": 0.25, "command_s": 0.3, "positioning_s": 0.4, "federation_s": 0.2, "clock_s": 0.25}
LIMITS_NS = {name: round(TIME_OUTS[f"{name}_s"] * SECOND) for name in (*SOURCES, "clock")}
FAULTS = (
    "none",
    *(f"{name} silent" for name in SOURCES),
    *(f"{name} never" for name in SOURCES),
    "future",
    "no command",
    "no pose",
    "pose nan",
    "pose false",
    "moved",
    "others nan",
    "clock back",
    "clock ahead",
    "clock late",
)
ROUNDING = 1e-6  # m


class Stretch(NamedTuple):
    """Some periods with one command and one fault; ``where`` is a displacement, for faults that need one.

    ``anew``: another run begins before it, if the robot is at rest.
    """

    command: tuple[float, float, float, float]
    periods: int
    fault: str = "none"
    where: tuple[float, float, float] = (0.0, 0.0, 0.0)
    anew: bool = False


class Rehearsal:
    """One sequence; `run` asserts the laws at every period.

    Args:
        flies: in the air, else on the ground.
        fence: name of it.
        keep: limits.
        exact: the robot follows commanded speeds at once; else it ramps.
        others: places (x, y, z) of others at rest, from the start.
        margin: between body and fence, m.
        climb: greatest vertical speed, m/s.
    """

    def __init__(
        self,
        flies: bool,
        fence: str,
        keep: Limits,
        exact: bool,
        others: Iterable[tuple[float, float, float]] = (),
        margin: float = 0.0,
        climb: float = 0.8,
    ) -> None:
        self.flies, self.fence, self.keep, self.exact = flies, FENCES[fence], keep, exact
        self.margin, self.climb = margin, climb if flies else 0.0
        common: dict[str, Any] = {"limits": keep, "radius_m": RADIUS, "fence": self.fence, "fence_margin_m": margin}
        common |= {"separation_m": SEPARATION, **TIME_OUTS}
        self.common = common
        start = STARTS[fence]
        self.truth = [float(start[0]), float(start[1]), 1.5, 0.3]  # x, y, z, yaw
        self.speeds: Any = (0.0, 0.0, 0.0, 0.0) if flies else (0.0, 0.0)
        rows = np.array(list(others), float).reshape(-1, 3) + np.array((*start, 1.5))
        gaps = self.gaps(rows)
        self.rows = rows[gaps > 0.0]
        self.now = self.real = 10 * SECOND  # by the clock of the steps, and true
        self.received_ns: dict[str, int | None] = dict.fromkeys(SOURCES, self.now)
        self.last = Velocity()
        self._begin()
        self.trusted, self.apart, self.worst = True, True, 0.0  # worst distance beyond the fence at which it was placed
        self.stops = self.periods = 0

    def _begin(self) -> None:
        """The first run, or another one: nothing is latched, and there was no step yet."""
        self.supervisor: Any
        if self.flies:
            parameters = safety_of(**self.common, max_climb=self.climb, floor_m=FLOOR, ceiling_m=CEILING)
            self.supervisor = AerialSupervisor(parameters)
        else:
            self.supervisor = GroundSupervisor(safety_of(**self.common))
        self.elapsed: int | None = None
        self.latched: set[str] = set()
        self.causes: tuple[Cause, ...] = ()

    def run(self, stretches: Iterable[Stretch]) -> None:
        for stretch in stretches:
            if stretch.anew and self._stands():
                self._begin()
            for number in range(stretch.periods):
                self._period(stretch, number)

    def _stands(self) -> bool:
        return not any(self.speeds) and self.last == Velocity()

    def _period(self, stretch: Stretch, number: int) -> None:
        fault, first = stretch.fault, number == 0
        if fault == "moved" and first:
            self.truth[:3] = [a + b for a, b in zip(self.truth[:3], stretch.where, strict=True)]
            self.trusted = False
        if first:
            jump = {"clock back": -0.15, "clock ahead": 0.7, "clock late": 0.15}.get(fault, 0.0)
            self.now += round(jump * SECOND)
            self.elapsed = None if self.elapsed is None else self.elapsed + round(jump * SECOND)
        pose = self._told_pose(stretch)
        command = None if fault == "no command" else self._command(stretch.command)
        ears = self._ears(fault)
        others = self._others(fault)
        problems = self._problems(command, pose, others, ears)
        decision = self.supervisor.step(
            self.now, command, pose, others, LastReceived(**{f"{k}_ns": v for k, v in ears.items()})
        )
        self.periods += 1
        self.stops += decision.stop
        assert decision.stop == bool(problems), (problems, decision.causes)
        assert not decision.stop or problems == {str(each) for each in decision.causes}
        assert set(decision.began) == set(decision.causes) - set(self.causes)
        self._check_command(decision)
        if not self.trusted and fault != "pose false" and self._stands():
            self.trusted, self.worst = True, min(0.0, self.inside())
            self.apart = self.apart and self.gap() >= 0.0  # a robot placed inside another may leave it along any axis
        self._move(decision.command)
        self.last, self.causes = decision.command, decision.causes
        self.now += PERIOD_NS
        self.elapsed = PERIOD_NS

    def _told_pose(self, stretch: Stretch) -> Any:
        pose = list(self.truth)
        if stretch.fault == "no pose":
            return None
        if stretch.fault == "pose nan":
            pose[round(abs(stretch.where[0])) % 2] = math.nan
        if stretch.fault == "pose false":
            pose[:3] = [a + b for a, b in zip(pose[:3], stretch.where, strict=True)]
            self.trusted = False
        return tuple(pose) if self.flies else (pose[0], pose[1], pose[3])

    def _command(self, numbers: tuple[float, float, float, float]) -> Velocity:
        x, y, z, w = numbers
        return Velocity(linear=(x, y, z) if self.flies else (x, 0.0, 0.0), yaw_rate=w)

    def _ears(self, fault: str) -> dict[str, int | None]:
        for name in SOURCES:
            if fault == f"{name} never":
                self.received_ns[name] = None
            elif fault != f"{name} silent":
                self.received_ns[name] = self.now + (1 if fault == "future" and name == "federation" else 0)
        return dict(self.received_ns)

    def _others(self, fault: str) -> Others | None:
        if not len(self.rows) and fault != "others nan":
            return None
        rows = self.rows if self.flies else self.rows[:, :2]
        if fault == "others nan":
            rows = np.full((1, rows.shape[1]), math.nan)
        return Others(rows, np.zeros_like(rows), np.full(len(rows), OTHER))

    def _problems(self, command: Velocity | None, pose: Any, others: Others | None, ears: dict[str, int | None]) -> set[str]:
        """Reasons to stop, by a plain reading of the rules."""
        late = {name for name in SOURCES if (at := ears[name]) is not None and self.now - at > LIMITS_NS[name]}
        if self.elapsed is not None and not 0 <= self.elapsed <= LIMITS_NS["clock"]:
            late.add("clock")
        if any(at is not None and at > self.now for at in ears.values()):
            late.add("clock")
        self.latched |= late & {"operator", "federation", "clock"}
        never = {name for name in SOURCES if ears[name] is None}
        missing = ({"command"} if command is None else set()) | ({"positioning"} if pose is None else set())
        numbers = [*(pose or ()), *((*command.linear, command.yaw_rate) if command else ())]
        if others is not None:
            numbers += others.position.ravel().tolist()
        ill = {"not_finite"} if not all(map(math.isfinite, numbers)) else set()
        return late | self.latched | never | missing | ill

    def _sizes(self, command: Velocity) -> Any:
        """Limited speeds: horizontal, vertical, and yaw rate."""
        x, y, z = command.linear
        return np.array([math.hypot(x, y), abs(z), abs(command.yaw_rate)])

    def _check_command(self, decision: Any) -> None:
        keep, command, last = self.keep, decision.command, self.last
        sizes, before = self._sizes(command), self._sizes(last)
        assert np.isfinite(sizes).all()
        assert (sizes <= np.array([keep.max_speed, self.climb, keep.max_yaw_rate]) + 1e-9).all()
        turns_back = 2 if self.flies else 0
        assert command.linear[turns_back] * last.linear[turns_back] >= 0.0  # it is at rest before that
        dt = 0.0 if self.elapsed is None else 0.1 if self.elapsed < 0 else min(self.elapsed / SECOND, 0.1)
        gain = np.array([keep.accel, keep.accel, keep.yaw_accel]) * dt
        loss = np.array([keep.decel, keep.decel, keep.yaw_decel]) * dt
        # a turn that slows down to zero within the period may be reversed in the rest of it
        assert (sizes <= before + gain + 1e-9).all()
        assert (sizes >= before - loss - 1e-9).all()
        assert not self.flies or math.dist(command.linear[:2], last.linear[:2]) <= loss[0] + 1e-9
        if decision.stop:
            assert (sizes <= np.maximum(0.0, before - loss) + 1e-9).all()

    def _move(self, command: Velocity) -> None:
        x, y, z, yaw = self.truth
        pieces: Any
        if self.flies:
            target_speeds = (*command.linear, command.yaw_rate)
            pieces = flight_of((x, y, z, yaw), self.speeds, target_speeds, 0.1, self.keep, ideal=self.exact)
        else:
            robot = ideal if self.exact else ramping
            pieces = robot((x, y, yaw), self.speeds, (command.linear[0], command.yaw_rate), 0.1, self.keep)
        for place, speeds in pieces:
            self.speeds = speeds
            self.truth = [*place] if self.flies else [place[0], place[1], z, place[2]]
            if self.trusted:
                inside = self.inside()
                assert inside >= self.worst - self._allowed(), (inside, self.worst)
                self.worst = max(self.worst, min(0.0, inside))
                assert not self.apart or self.gap() >= -ROUNDING

    def _allowed(self) -> float:
        """A robot outside of a polygon returns at a low speed; at a corner either side may be the nearest."""
        return ROUNDING + (0.1 * RETURN_MPS if self.worst < 0.0 else 0.0)

    def inside(self) -> float:
        """Distance to fence, floor and ceiling, m; negative beyond one of them."""
        across = room(self.fence, *self.truth[:2]) - RADIUS - self.margin
        return min(across, self.truth[2] - FLOOR, CEILING - self.truth[2]) if self.flies else across

    def gap(self) -> float:
        """Distance to the nearest other, m."""
        return float(self.gaps(self.rows).min(initial=math.inf))

    def gaps(self, rows: Any) -> Any:
        """Distance to the cylinder, on the ground the circle, of each other."""
        apart = RADIUS + OTHER + SEPARATION
        beside = np.hypot(rows[:, 0] - self.truth[0], rows[:, 1] - self.truth[1]) - apart
        return np.maximum(beside, np.abs(rows[:, 2] - self.truth[2]) - apart) if self.flies else beside
