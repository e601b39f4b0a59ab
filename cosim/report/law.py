"""Theory against measurement: one row of the comparison, and the run as the laws see it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.metrics.window import Window
from vcmvsp.cosim.report.link_counts import Links
from vcmvsp.cosim.tables.schema import Placement, Recording

NORMAL_95 = 1.96


@dataclass(frozen=True)
class Expected:
    """A number that a law gives, and what was measured."""

    quantity: str
    expected: float
    measured: float | None
    law: str
    holds: str  # why the law applies
    unit: str = ""
    spread: float | None = None  # half of the range in which 95 % of all such runs lie


@dataclass(frozen=True)
class MeasuredRun:
    """A run that is compared with theory: all of its parts are there."""

    scenario: Mapping[str, Any]
    metrics: Mapping[str, Any]
    recording: Recording
    links: Links
    moved: Motion

    @property
    def radio(self) -> Mapping[str, Any]:
        """The layers of the channel."""
        found: Mapping[str, Any] = self.scenario["radio"]
        return found

    @property
    def window(self) -> Window:
        """What is evaluated, s."""
        said = self.scenario["metrics"]
        return said["from_s"], said.get("to_s")

    def vehicle(self, name: str) -> Mapping[str, Any]:
        """What is said of a vehicle, its own table before that of all."""
        own = {each["name"]: each for each in self.scenario["vehicle"]}
        return {**self.scenario["vehicles"], **own[name]}

    def agent(self, vehicle: str) -> Mapping[str, Any]:
        """What a vehicle's agent was told, likewise."""
        return {**self.scenario["agents"], **self.vehicle(vehicle).get("agent", {})}

    @property
    def steady(self) -> list[Placement]:
        """Who keeps which place, where that never changes; nobody where it does."""
        follows = self.recording.follows
        changes = len({each.vehicle for each in follows}) < len(follows)
        return [] if changes else [each for each in follows if each.follows.leader is not None]
