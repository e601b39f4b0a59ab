"""Contacts of all engines, in rows of the run, and the events of new contacts."""

from collections.abc import Sequence

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Array, Contact
from vcmvsp.physics.engine.interface import Bodiless, Engine, Touch


class Contacts:
    """Contacts of all engines.

    Args:
        engines: each with the rows (k,) of its vehicles in the run.
        vehicles: number of vehicles.
        names: of all bodies: vehicles first, then movables and moving obstacles.
    """

    def __init__(self, engines: Sequence[tuple[Engine, Array]], vehicles: int, names: tuple[str, ...]) -> None:
        self._names = names
        others = range(vehicles, len(names))
        self._engines = [(each, [*rows.tolist(), *others]) for each, rows in engines if not isinstance(each, Bodiless)]
        self._touching: frozenset[tuple[int, int | None]] = frozenset()

    def now(self, *, passing: bool) -> list[Touch]:
        """Present contacts; ``passing`` as in `Engine.touching`."""
        touches = []
        for engine, rows in self._engines:
            for touch in engine.touching(passing=passing):
                other = None if touch.other is None else rows[touch.other]
                touches.append(touch._replace(row=rows[touch.row], other=other))
        return touches

    def begun(self, now_ns: int) -> list[Event]:
        """Contacts that began since the last call, also short ones that have ended."""
        if not self._engines:
            return []
        pairs = dict.fromkeys((each.row, each.other) for each in self.now(passing=True))
        begun = [pair for pair in pairs if pair not in self._touching]
        self._touching = frozenset(pairs)
        events = []
        for row, other in begun:
            contact = Contact(vehicle=self._names[row], other=None if other is None else self._names[other])
            events.append(Event("world/contact", now_ns, contact))
        return events
