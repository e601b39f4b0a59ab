"""gradysim (GrADyS-SIM NextGen): nodes at rest that broadcast ten times a second.

``--agents``, ``--span_s``, ``--loss``; ``--way decide``: its channel alone, which decides the receivers of a message and
queues the arrivals.
"""

from collections.abc import Callable
from typing import Any

from gradysim.protocol.interface import IProtocol  # type: ignore[import-not-found]
from gradysim.protocol.messages.communication import BroadcastMessageCommand  # type: ignore[import-not-found]
from gradysim.simulator.handler.communication import (  # type: ignore[import-not-found]
    CommunicationHandler,
    CommunicationMedium,
)
from gradysim.simulator.handler.timer import TimerHandler  # type: ignore[import-not-found]
from gradysim.simulator.simulation import SimulationBuilder, SimulationConfiguration  # type: ignore[import-not-found]

from bench.peers.pace import MESSAGE, Options, stretches

RATE_HZ = 10


class Counter(IProtocol):  # type: ignore[misc]
    """Broadcasts, and counts receptions."""

    heard = 0  # of all nodes

    def initialize(self) -> None:
        """Begin at once."""
        self._sent = 0
        self.handle_timer("")

    def handle_timer(self, timer: str) -> None:
        """Broadcast, and wait for the next time."""
        self.provider.send_communication_command(BroadcastMessageCommand(MESSAGE))
        self._sent += 1
        self.provider.schedule_timer("", self._sent / RATE_HZ)

    def handle_packet(self, message: str) -> None:
        """Count."""
        Counter.received += 1

    def handle_telemetry(self, telemetry: object) -> None:
        """Nodes are at rest: there is no telemetry."""

    def finish(self) -> None:
        """Nothing."""


def built(settings: Options) -> tuple[Any, CommunicationHandler]:
    """A simulation without physics, and its channel."""
    medium = CommunicationMedium(transmission_range=1e6, failure_rate=settings.loss)
    radio = CommunicationHandler(medium)
    duration_s = settings.span_s - 0.5 / RATE_HZ  # without the broadcast at its end
    builder = SimulationBuilder(SimulationConfiguration(duration=duration_s, execution_logging=False))
    builder.add_handler(radio).add_handler(TimerHandler())
    for number in range(settings.agents):
        builder.add_node(Counter, (3.0 * (number % 10), 3.0 * (number // 10), 0.0))
    return builder.build(), radio


def work(settings: Options) -> Callable[[], None]:
    """Each call builds and makes a run of its own, or the same number of decisions."""
    return deciding(settings) if settings.way == "decide" else lambda: run(settings)


def run(settings: Options) -> None:
    """From the first to the last broadcast."""
    Counter.received = 0
    simulation, _ = built(settings)
    simulation.start_simulation()
    sent = settings.agents * round(RATE_HZ * settings.span_s)
    share = Counter.received / (sent * (settings.agents - 1))
    assert abs(share - (1.0 - settings.loss)) < 0.05, share


def deciding(settings: Options) -> Callable[[], None]:
    """The channel's work on a message alone."""
    simulation, radio = built(settings)
    command, events = BroadcastMessageCommand(MESSAGE), simulation._event_loop
    nodes = [simulation.get_node(number) for number in range(settings.agents)]

    def decide() -> None:
        for _ in range(round(RATE_HZ * settings.span_s)):
            for node in nodes:
                radio.handle_command(command, node)
            events.clear()

    return decide


if __name__ == "__main__":
    stretches(work)
