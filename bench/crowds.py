"""Crowds of vehicles that broadcast their positions, and how many of them one core carries at real time."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from bench.growth import HANDOVER_S, crowd
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Positive, Velocity

MOST = 1024  # vehicles: the largest number tried
TICK_S = 0.1  # between two instants of all agents
ITERATIONS = 20  # of Bullet's solver
RADIOS: Mapping[str, Mapping[str, Any]] = {
    "ideal radio": {"preset": "ideal"},
    "802.11g with contention": {"preset": "wifi-g-6", "handover_s": HANDOVER_S},
}


class Teller(Agent):
    """Drives or flies a small circle and broadcasts its position, at a phase of its own.

    Args:
        report_s: time between two broadcasts, s.
    """

    def __init__(self, report_s: Positive) -> None:
        self._report_s = report_s

    def start(self, info: VehicleInfo) -> None:
        """Note the time of the first report."""
        self._next_s = info.stream("report").uniform(0.0, self._report_s) - TICK_S

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Continue the circle."""
        if obs.time_s >= self._next_s:
            self._next_s += self._report_s
            x, y, z = obs.state.position
            radio.send(x=x, y=y, z=z)
        return Velocity(linear=(0.2, 0.0, 0.0), yaw_rate=0.4)


def team(kinds: Mapping[str, int], hz: float, radio: Mapping[str, Any], duration_s: float) -> dict[str, Any]:
    """A crowd of several kinds, each vehicle of which broadcasts ``hz`` times a second; quadrotors 10 m above the floor."""
    names = [kind for kind, count in kinds.items() for _ in range(count)]
    bodies = any(kind != "kinematic" for kind in names)
    raw = crowd(len(names), "bullet" if bodies else "kinematic", "ideal", duration_s)
    for vehicle, kind in zip(raw["vehicle"], names, strict=True):
        x, y, _ = vehicle.pop("pose")
        vehicle |= {"kind": kind, "position": (x, y, 10.0 if kind == "quadrotor" else 0.0), "agent": {}}
    physics = {"physics": {"kind": "bullet", "iterations": ITERATIONS}} if bodies else {}
    agents = {"kind": "bench.crowds:Teller", "period_s": TICK_S, "report_s": 1.0 / hz}
    return raw | physics | {"radio": dict(radio), "vehicles": {}, "agents": agents}


class Reached(NamedTuple):
    """Number of vehicles at real time, from measurements: CPU s per simulated s by number."""

    number: int
    measured: Mapping[int, float]

    @property
    def words(self) -> str:
        """The number, and how it was found."""
        largest = max(self.measured)
        if self.measured[largest] < 1.0:
            if self.number > 2 * largest:
                return f"more than {largest}"
            return f"about {self.number}, reckoned beyond {largest} ({self.measured[largest]:.2f})"
        below, above = _around(self.measured)
        if not below:
            return f"fewer than {above} ({self.measured[above]:.2f})"
        measurements = [f"{n}: {self.measured[n]:.2f}" for n in (below, above)]
        return f"{self.number} ({', '.join(measurements)})"


def reach(cost: Callable[[int], float], first: int) -> Reached:
    """Doubles or halves the number until the cost passes 1, and measures once more between the last two.

    Args:
        cost: CPU s per simulated s of a number of vehicles.
        first: number to begin with.
    """
    measured = {first: cost(first)}
    number = first
    while measured[number] < 1.0 and number < MOST:
        number = min(2 * number, MOST)
        measured[number] = cost(number)
    while min(measured.values()) >= 1.0 and number > 1:
        number //= 2
        measured[number] = cost(number)
    below, above = _around(measured)
    if below and above:
        between = _where_one(measured, below, above)
        if below < between < above:
            measured[between] = cost(between)
            below, above = _around(measured)
        return Reached(_where_one(measured, below, above), measured)
    if above:
        return Reached(0, measured)  # not even one
    numbers = sorted(measured)
    return Reached(_where_one(measured, numbers[-2], numbers[-1]) if len(numbers) > 1 else 2 * MOST + 1, measured)


def _around(measured: Mapping[int, float]) -> tuple[int, int]:
    """The least number with a cost of 1 or more, and the largest below it; 0: there is none."""
    above = min((n for n, seconds in measured.items() if seconds >= 1.0), default=0)
    below = max((n for n, seconds in measured.items() if seconds < 1.0 and (not above or n < above)), default=0)
    return below, above


def _where_one(measured: Mapping[int, float], below: int, above: int) -> int:
    """Where a straight line through both logarithms has a cost of 1."""
    slope = math.log(measured[above] / measured[below]) / math.log(above / below)
    if slope <= 0.0:
        return 2 * above + 1
    return round(below * min(1e3, math.exp(-math.log(measured[below]) / slope)))
