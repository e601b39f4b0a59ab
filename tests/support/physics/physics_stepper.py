"""A federate stepped by itself, as a kernel would."""

from collections.abc import Iterator, Sequence

from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.physics.federate import Physics


def stepped(physics: Physics, run: RunInfo, told: Sequence[Event]) -> Iterator[list[Event]]:
    """What each step of a whole run gives; what it is told is handed over at the first step at or after its time."""
    waiting = list(told)
    next_ns: int | None = physics.start(run)
    try:
        while next_ns is not None:
            now_ns = next_ns
            inbox = [event for event in waiting if event.time_ns <= now_ns]
            waiting = [event for event in waiting if event.time_ns > now_ns]
            step = physics.step(now_ns, inbox)
            next_ns = step.next_ns
            yield list(step.events)
    finally:
        physics.close()
