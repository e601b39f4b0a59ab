"""Replay of the datagrams of programs from a recorded run, instead of the bridge."""

from collections.abc import Sequence

from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.types import Datagrams


class BridgePlayback:
    """The federate ``bridge`` from recorded ``inputs`` (`cosim.recording.external_inputs`), of which it takes the datagrams."""

    name = "bridge"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    reads: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(self, inputs: Sequence[Input]) -> None:
        self._events = [Event(key, time_ns, value) for key, time_ns, value in inputs if isinstance(value, Datagrams)]

    def start(self, run: RunInfo) -> int | None:
        """Time of the first event."""
        self._next = 0
        return self._events[0].time_ns if self._events else None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """The events of this instant."""
        first, events = self._next, self._events
        while self._next < len(events) and events[self._next].time_ns <= now_ns:
            self._next += 1
        return Step(events[first : self._next], events[self._next].time_ns if self._next < len(events) else None)

    def close(self) -> None:
        """Nothing to release."""
