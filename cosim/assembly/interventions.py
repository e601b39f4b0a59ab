"""Interventions of an operator during a run: planned in the scenario, or requested live.

Both kinds become events at an instant of the run, which physics, radio and hardware apply like commands and frames. The
resolved scenario lists live interventions with the time at which they were applied: running it gives the same bytes.
"""

from collections.abc import Callable, Sequence
from operator import attrgetter

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.config.binding import problem_of, unfit_number, unknown
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import HaltTable, InterventionTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.types import Changed, Halted, Moved, Outage

Check = Callable[[InterventionTable, Sequence[InterventionTable]], None]
"""Raises `ValueError` if an intervention cannot be applied after the given earlier ones."""


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
        self._requests: list[InterventionTable] = []
        self.done: list[InterventionTable] = []  # in order of application

    def start(self, run: RunInfo) -> int | None:
        """Wake up at the first planned intervention."""
        return self._next()

    def ask(self, intervention: InterventionTable) -> None:
        """Apply an intervention at the next instant; its own ``at_s`` is ignored.

        Raises:
            ValueError: it cannot be applied; the text says why.
        """
        raw = msgspec.to_builtins(intervention)
        if (bad := unfit_number(raw)) is not None:
            raise ValueError(f"all numbers: {problem_of(bad)}")
        checked = msgspec.convert(raw, type(intervention))  # checks ranges; the constructor does not
        self._check(checked, self._requests)
        match checked:
            case MoveTable():
                self._check_alone(checked)
            case SetTable():
                self._check_planned(checked)
        self._requests.append(checked)

    def poll(self, now_ns: int) -> bool:
        """Whether an intervention is to be applied at the instant that begins."""
        return bool(self._requests)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Apply the planned interventions that are due, then the requested ones."""
        due = [each for each in self._planned if seconds_to_ns(each.at_s) <= now_ns]
        self._planned = self._planned[len(due) :]
        requests, self._requests = self._requests, []
        doing = due + [_at(each, now_ns) for each in requests]
        self.done += doing
        return Step([self._event(each, now_ns) for each in doing], self._next())

    def close(self) -> None:
        """Nothing to release."""

    @property
    def all(self) -> list[InterventionTable]:
        """Applied interventions, then planned ones."""
        return self.done + self._planned

    def _check_alone(self, move: MoveTable) -> None:
        """Reject a second move at one instant: checks use current positions, so both might claim one place."""
        if any(isinstance(each, MoveTable) and each.obstacle != move.obstacle for each in self._requests):
            raise ValueError(f"{move.obstacle} was not moved: another obstacle moves at this instant; move one at a time")

    def _check_planned(self, change: SetTable) -> None:
        """Reject a change that would make a planned change impossible."""
        before = [*self._requests, change]
        for each in self._planned:
            if isinstance(each, SetTable):
                try:
                    self._check(each, before)
                except ValueError as error:
                    raise ValueError(f"the change planned at {each.at_s:g} s would become impossible: {error}") from error
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
    """A check of interventions: existing vehicles, movable obstacles, changeable keys."""

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
    """Reject every obstacle: for user-defined physics without movable obstacles."""
    raise ValueError(f"{obstacle} cannot be moved: this physics has no check_move(obstacle, position, yaw)")


def check_planned(planned: Sequence[InterventionTable], check: Check, source: Source) -> None:
    """Reject a scenario with an intervention that cannot be applied."""
    order = sorted(range(len(planned)), key=lambda number: planned[number].at_s)
    for place, number in enumerate(order):
        try:
            check(planned[number], [planned[each] for each in order[:place]])
        except ValueError as error:
            raise source.error(str(error), f"intervention[{number}]") from error


def _at(table: InterventionTable, now_ns: int) -> InterventionTable:
    return msgspec.structs.replace(table, at_s=now_ns / SECOND_NS)
