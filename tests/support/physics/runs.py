"""Runs of physics alone, stepped as by a kernel."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from vcmvsp.cosim.clock import Ticks, seconds_to_ns
from vcmvsp.cosim.federate import Event, Instants, RunInfo
from vcmvsp.cosim.types import Velocity, Waypoint
from vcmvsp.physics.federate import Physics

TENTH = (Instants(Ticks.every(0.1)),)
Command = tuple[float, str, float, float] | tuple[float, str, Velocity | Waypoint]
"""From when, s; vehicle; v m/s and w rad/s of a vehicle on the ground, or any command."""


def event_of(order: Event | Command) -> Event:
    if isinstance(order, Event):
        return order
    at_s, name, *numbers = order
    first: Any = numbers[0]
    command = first if len(numbers) == 1 else Velocity(linear=(first, 0.0, 0.0), yaw_rate=order[-1])  # type: ignore[arg-type]
    return Event(f"{name}/command", seconds_to_ns(at_s), command)


def run_info(physics: Physics, seconds: float, instants: Iterable[Instants] = TENTH, *, seed: int = 1, **rest: Any) -> RunInfo:
    names = tuple(spec.name for spec in physics.vehicles)
    return RunInfo(
        scenario="test", seed=seed, duration_ns=seconds_to_ns(seconds), vehicles=names, instants=tuple(instants), **rest
    )


def steps_of(
    physics: Physics,
    orders: Iterable[Event | Command] = (),
    seconds: float = 2.0,
    instants: Iterable[Instants] = TENTH,
    **rest: Any,
) -> Iterator[list[Event]]:
    """Result of each step of a whole run; inputs are delivered at the first step at or after their time.

    ``rest``: of the `RunInfo`.
    """
    waiting = sorted(map(event_of, orders), key=lambda each: each.time_ns)
    next_ns: int | None = physics.start(run_info(physics, seconds, instants, **rest))
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


def play(*run: Any, **rest: Any) -> list[list[Event]]:
    """The events of each step of a run, see `steps_of`."""
    return list(steps_of(*run, **rest))


def run(*run: Any, **rest: Any) -> list[Event]:
    """All events of a run, see `steps_of`."""
    return [event for events in steps_of(*run, **rest) for event in events]


def values(events: Sequence[Event], key: str) -> list[Any]:
    """Values of a key, in order."""
    return [event.value for event in events if event.key == key]
