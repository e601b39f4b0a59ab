"""What theory expects of a run, beside what came out. A row stands only where the scenario fulfils what its law asks for.

The half-widths are of 95 % of all runs that differ in their draws alone; where a law leaves nothing to chance there is none.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from vcmvsp.cosim.metrics import Motion, Window, motion
from vcmvsp.cosim.report.link_counts import Links
from vcmvsp.cosim.report.page import Part, Rows, Words, cell
from vcmvsp.cosim.report.run_folder import Left
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
class Seen:
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


def expectation_table(left: Left) -> list[Part]:
    """What was expected and what was measured; nothing where no law applies."""
    rows = list(_expected(left))
    if not rows:
        return []
    head = ["quantity", "unit", "expected", "95 % of runs", "measured", "law", "it holds because"]
    return [
        Words("Closed forms, where this scenario is as they assume. Chance alone puts one number in twenty outside its range."),
        Rows(head, [_row(each) for each in rows]),
    ]


def _expected(left: Left) -> Iterator[Expected]:
    from vcmvsp.cosim.report import motion_laws, radio_laws

    recording = left.recording
    if recording is None or left.links is None or not left.scenario or not left.metrics:
        return
    if left.scenario.get("intervention"):  # the operator had a hand in it
        return
    seen = Seen(left.scenario, left.metrics, recording, left.links, motion(recording.states))
    try:
        yield from radio_laws.laws(seen)
        yield from motion_laws.laws(seen)
    except KeyError:  # a scenario of another version lacks a key that a law needs
        return


def _row(each: Expected) -> list[Any]:
    low_high = None
    if each.spread is not None:
        low_high = f"{cell(each.expected - each.spread)} to {cell(each.expected + each.spread)}"
    return [each.quantity, each.unit, each.expected, low_high, each.measured, each.law, each.holds]
