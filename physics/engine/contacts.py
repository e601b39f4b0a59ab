"""Who touches whom, in rows of the whole run, and which contacts are new."""

from collections.abc import Sequence

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Array, Contact
from vcmvsp.physics.engine.interface import Bodiless, Engine, Touch


class Contacts:
    """Contacts of all engines.

    Args:
        engines: each with the rows (k,) that its vehicles have in the run.
        vehicles: how many there are.
        names: of all bodies: vehicles first, then movables and moving obstacles.
    """

    def __init__(self, engines: Sequence[tuple[Engine, Array]], vehicles: int, names: tuple[str, ...]) -> None:
        self._names = names
        others = range(vehicles, len(names))
        self._engines = [(each, [*rows.tolist(), *others]) for each, rows in engines if not isinstance(each, Bodiless)]
        self._touching: frozenset[tuple[int, int | None]] = frozenset()

    def now(self, *, passing: bool) -> list[Touch]:
        """What touches now; ``passing`` as `Engine.touching` takes it."""
        return [
            each._replace(row=rows[each.row], other=None if each.other is None else rows[each.other])
            for engine, rows in self._engines
            for each in engine.touching(passing=passing)
        ]

    def begun(self, now_ns: int) -> list[Event]:
        """Contacts that began since this was asked for last, those among them that have ended already included."""
        if not self._engines:
            return []
        pairs = dict.fromkeys((each.row, each.other) for each in self.now(passing=True))
        begun = [pair for pair in pairs if pair not in self._touching]
        self._touching = frozenset(pairs)
        named = [Contact(vehicle=self._names[a], other=None if b is None else self._names[b]) for a, b in begun]
        return [Event("world/contact", now_ns, each) for each in named]
