"""Runs of a radio with routing among vehicles at rest."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from tests.support.cosim.receptions import receptions_in
from tests.support.netsim.bridge_runs import PlainFederate
from tests.support.netsim.channels import at_rest, make_channel
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.types import FrameReport, Message, Reception, Receptions, Routed, Traffic
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.routing.router import Routing

MS = 1_000_000
AIR_NS = 1_280_000  # of 100 B by wifi-b-1
HOP_NS = AIR_NS + 64_000  # with the header


class RoutedReception(NamedTuple):
    """A reception: receiver, message and time."""

    receiver: str
    sender: str
    sent_ns: int
    received_ns: int


class Run(NamedTuple):
    """Results of a run."""

    frames: list[FrameReport]
    routed_receptions: list[RoutedReception]
    routed: list[Routed]
    traffic: list[Traffic]
    traffic_ns: list[int]  # when it was reported
    receptions: list[Reception]

    @property
    def messages(self) -> list[Routed]:
        return [each for each in self.routed if not each.update]


class World(PlainFederate):
    """Publishes the vehicles' positions."""

    name, slot, wake_slot = "world", Slot.WORLD, Slot.APPLY

    def __init__(self, position: Sequence[Sequence[float]], events: Sequence[Event]) -> None:
        self._position, self._events = position, events

    def start(self, run: RunInfo) -> int | None:
        self._names = run.vehicles
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        states = at_rest(self._names, [(*place, 0.0)[:3] for place in self._position])
        return Step([Event("world/states", 0, states), *self._events])


def message_at(sender: str, at_ns: int, *, to: str | None = None, size_bytes: int = 100) -> Event:
    """A message with its time as content."""
    return Event(f"{sender}/send", at_ns, Message(sender=sender, body={"t": at_ns}, size_bytes=size_bytes, to=to))


def line(count: int, step_m: float = 60.0) -> list[tuple[float, float]]:
    """Vehicles in a row; by wifi-b-1 (86 m) each reaches the next."""
    return [(step_m * i, 0.0) for i in range(count)]


def names(count: int) -> tuple[str, ...]:
    """Names of a number of vehicles."""
    return tuple(f"car{i + 1}" for i in range(count))


def run(
    router: Routing | None,
    position: Sequence[Sequence[float]],
    *events: Event,
    seconds: float = 1.0,
    seed: int = 1,
    preset: str = "wifi-b-1",
    **layers: Any,
) -> Run:
    """A run with these messages."""
    published: list[Event] = []
    info = RunInfo(scenario="test", seed=seed, duration_ns=round(seconds * 1e9), vehicles=names(len(position)))
    channel = make_channel(preset, vehicles=info.vehicles, **layers)
    kernel = Kernel(info, [World(position, events), RadioFederate(channel, router=router)])
    kernel.start()
    kernel.run(published.append)
    kernel.close()
    receptions = list(receptions_in(published))
    values: list[Any] = [event.value for event in published]
    published_ns = [event.time_ns for event in published if isinstance(event.value, Receptions) for _ in event.value.receiver]
    arrival_ns = [each.received_ns for _, each in receptions]
    assert all(at_ns <= arrived_ns for at_ns, arrived_ns in zip(published_ns, arrival_ns, strict=True))
    assert router is None or published_ns == arrival_ns
    return Run(
        [each for each in values if isinstance(each, FrameReport)],
        [RoutedReception(name, each.message.sender, each.sent_ns, each.received_ns) for name, each in receptions],
        [each for each in values if isinstance(each, Routed)],
        [each for each in values if isinstance(each, Traffic)],
        [event.time_ns for event in published if isinstance(event.value, Traffic)],
        [each for _, each in receptions],
    )
