"""What an operator does during a run: known beforehand, or asked for while it goes on.

Both take the same way: at an instant of the run an event says what is done, and physics, radio and hardware obey it as they do
commands and frames. What was asked for live is written into the resolved scenario with the time at which it was done, so that
running that again gives the same bytes.
"""

from collections.abc import Callable, Sequence
from operator import attrgetter

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.config.binding import problem_of, unfit_number, unknown
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import HaltTable, InterventionTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.types import Changed, Halted, Moved, Outage

Check = Callable[[InterventionTable, Sequence[InterventionTable]], None]
"""Raises `ValueError` for what cannot be done, after what will have been done before it."""


class Operator:
    """The federate that publishes interventions.

    =====================  =========  ===================================
    key                    direction  value
    =====================  =========  ===================================
    ``operator/outage``    out        `Outage`
    ``operator/halted``    out        `Halted`
    ``operator/moved``     out        `Moved`
    ``operator/changed``   out        `Changed`
    =====================  =========  ===================================
    """

    name = "operator"
    slot = Slot.WORLD
    wake_slot = Slot.WORLD
    reads: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(self, planned: Sequence[InterventionTable], vehicles: Sequence[str], check: Check) -> None:
        self._vehicles, self._check = tuple(vehicles), check
        self._planned = sorted(planned, key=attrgetter("at_s"))
        self._asked: list[InterventionTable] = []
        self.done: list[InterventionTable] = []  # in the order in which they were

    def start(self, run: RunInfo) -> int | None:
        """Wait for the first that is planned."""
        return self._next()

    def ask(self, intervention: InterventionTable) -> None:
        """Do this at the next instant, whatever time it names.

        Raises:
            ValueError: it cannot be done, and why.
        """
        raw = msgspec.to_builtins(intervention)
        if (bad := unfit_number(raw)) is not None:
            raise ValueError(f"every number {problem_of(bad)}")
        checked = msgspec.convert(raw, type(intervention))  # ranges, which no constructor looks at
        self._check(checked, self._asked)
        match checked:
            case MoveTable():
                self._check_alone(checked)
            case SetTable():
                self._check_planned(checked)
        self._asked.append(checked)

    def poll(self, now_ns: int) -> bool:
        """Whether there is anything to be done at the instant that begins."""
        return bool(self._asked)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Do what is due and what was asked for, in this order."""
        due = [each for each in self._planned if seconds_to_ns(each.at_s) <= now_ns]
        self._planned = self._planned[len(due) :]
        asked, self._asked = self._asked, []
        doing = due + [_at(each, now_ns) for each in asked]
        self.done += doing
        return Step([self._event(each, now_ns) for each in doing], self._next())

    def close(self) -> None:
        """Nothing to release."""

    @property
    def all(self) -> list[InterventionTable]:
        """What was done, and what is still planned."""
        return self.done + self._planned

    def _check_alone(self, move: MoveTable) -> None:
        """Refuse a second obstacle at one instant: each was checked against where the other is now; both may want one place."""
        if any(isinstance(each, MoveTable) and each.obstacle != move.obstacle for each in self._asked):
            raise ValueError(f"{move.obstacle} stays: another obstacle is moved at this instant, let the run go on first")

    def _check_planned(self, change: SetTable) -> None:
        """Refuse what would make a change impossible that is still planned."""
        before = [*self._asked, change]
        for each in self._planned:
            if isinstance(each, SetTable):
                try:
                    self._check(each, before)
                except ValueError as error:
                    raise ValueError(f"what is planned at {each.at_s:g} s could not be done then: {error}") from error
                before.append(each)

    def _next(self) -> int | None:
        return seconds_to_ns(self._planned[0].at_s) if self._planned else None

    def _event(self, table: InterventionTable, now_ns: int) -> Event:
        match table:
            case OutageTable():
                until_ns = now_ns + seconds_to_ns(table.for_s)
                return Event("operator/outage", now_ns, Outage(vehicles=table.vehicles or self._vehicles, until_ns=until_ns))
            case HaltTable():
                halted = Halted(vehicles=table.vehicles or self._vehicles, halted=table.halted)
                return Event("operator/halted", now_ns, halted)
            case MoveTable():
                return Event("operator/moved", now_ns, Moved(obstacle=table.obstacle, position=table.position, yaw=table.yaw))
            case SetTable():
                return Event("operator/changed", now_ns, Changed(key=table.key, value=table.value))


def checks(
    vehicles: Sequence[str],
    check_move: Callable[[str, tuple[float, float], float], None],
    check_set: Callable[[str, float, Sequence[tuple[str, float]]], None],
) -> Check:
    """What can be done at all: with vehicles that there are, obstacles that can be moved, and keys that can be changed."""

    def check(table: InterventionTable, earlier: Sequence[InterventionTable]) -> None:
        if isinstance(table, OutageTable | HaltTable):
            for name in table.vehicles:
                if name not in vehicles:
                    raise ValueError(unknown("vehicle", name, vehicles))
        elif isinstance(table, MoveTable):
            check_move(table.obstacle, table.position, table.yaw)
        else:
            check_set(table.key, table.value, [(each.key, each.value) for each in earlier if isinstance(each, SetTable)])

    return check


def nothing_moves(obstacle: str, *_: object) -> None:
    """For physics of one's own that knows no obstacles which can be moved: refuses all of them."""
    raise ValueError(f"{obstacle} cannot be moved: this physics has no check_move(obstacle, position, yaw)")


def check_planned(planned: Sequence[InterventionTable], check: Check, source: Source) -> None:
    """Refuse a scenario with an intervention that cannot be done."""
    order = sorted(range(len(planned)), key=lambda number: planned[number].at_s)
    for place, number in enumerate(order):
        try:
            check(planned[number], [planned[each] for each in order[:place]])
        except ValueError as error:
            key = f"intervention[{number}]"
            raise ScenarioError(str(error), key=key, source=source.of(key)) from error


def _at(table: InterventionTable, now_ns: int) -> InterventionTable:
    return msgspec.structs.replace(table, at_s=now_ns / SECOND_NS)
