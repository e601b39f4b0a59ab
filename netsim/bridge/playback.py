"""What programs handed over in an earlier run, at the times at which they did: in the place of the bridge."""

from collections.abc import Sequence

from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.types import Datagrams


class BridgePlayback:
    """The federate ``bridge`` out of the inputs of a run; what it would deliver, nobody takes.

    Args:
        inputs: what `cosim.recording.external_inputs.read_inputs` gives; all but datagrams are left out.
    """

    name = "bridge"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    reads: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(self, inputs: Sequence[Input]) -> None:
        self._events = [Event(key, time_ns, value) for key, time_ns, value in inputs if isinstance(value, Datagrams)]

    def start(self, run: RunInfo) -> int | None:
        """The first event's time."""
        self._given = 0
        return self._events[0].time_ns if self._events else None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """The events of this instant."""
        first, events = self._given, self._events
        while self._given < len(events) and events[self._given].time_ns <= now_ns:
            self._given += 1
        return Step(events[first : self._given], events[self._given].time_ns if self._given < len(events) else None)

    def close(self) -> None:
        """Nothing to release."""
