"""Search for the vehicle at an address by its heartbeats; each mismatch has its own error.

It has no clock and no link: bytes and times are arguments, the result is a `Peer` or an error.
"""

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Value
from vcmvsp.hardware.drivers.base import HandshakeError
from vcmvsp.hardware.drivers.mavlink.autopilots import (
    COPTERS,
    GROUND,
    KINDS,
    Autopilot,
    Kind,
    autopilot_of,
    is_autopilot,
    type_name,
)
from vcmvsp.hardware.drivers.mavlink.codec import Message, MessageReader, Sender, sender_of
from vcmvsp.hardware.drivers.mavlink.link import Chunks

LISTEN_S = 1.5  # after the first vehicle, for another; heartbeats come once a second
READERS = 32  # maximum number of sources


class Peer(Value, frozen=True, kw_only=True):
    """The vehicle."""

    sender: Sender
    source: str
    vehicle_type: int
    autopilot: Autopilot
    heartbeat: Message  # the newest

    @property
    def on_ground(self) -> bool:
        """It drives or swims: velocities are in its body frame."""
        return self.vehicle_type in GROUND

    @property
    def name(self) -> str:
        """For messages."""
        return f"system {self.sender.system}: {type_name(self.vehicle_type)} with {self.autopilot.name}"


class VehicleSearch:
    """Searches the vehicle.

    Args:
        device: for messages.
        system_id: of the vehicle; 0: the only one.
        kind: of the autopilot; None: from its heartbeat.
    """

    def __init__(self, device: str, system_id: int, kind: Kind | None) -> None:
        self._device, self._system_id, self._kind = device, system_id, kind
        self._readers: dict[str, MessageReader] = {}
        self._found: dict[tuple[Sender, str], Message] = {}  # newest heartbeat by sender and source
        self._others: dict[int, str] = {}  # other systems
        self._first_ns = 0
        self._heard = 0

    def receive(self, chunks: Chunks, now_ns: int) -> Peer | None:
        """Process bytes; the vehicle, if it is determined now."""
        for source, data in chunks:
            self._heard += len(data)
            reader = self._readers.setdefault(source, MessageReader())
            if len(self._readers) > READERS:
                del self._readers[next(iter(self._readers))]
            for message in reader.feed(data):
                if message.get_type() == "HEARTBEAT":
                    self._take(message, source, now_ns)
        return self.decide(now_ns)

    def decide(self, now_ns: int) -> Peer | None:
        """The vehicle, if it is determined by now."""
        if not self._found or now_ns < self.due_ns:
            return None
        if len(self._found) > 1:
            systems = sorted({sender.system for sender, _ in self._found})
            if len(systems) == 1:
                happened = f"system {systems[0]} speaks from more than one place"
                raise HandshakeError(self._device, happened, "give each vehicle a number of its own, or a port of its own")
            happened = f"systems {_listed(systems)} speak here"
            raise HandshakeError(self._device, happened, f"say which one is meant: system_id = {systems[0]}")
        ((sender, source), heartbeat), *_ = self._found.items()
        return self._peer(sender, source, heartbeat)

    @property
    def due_ns(self) -> int:
        """Time at which `decide` may have an answer; far away without a vehicle."""
        if not self._first_ns:
            return 1 << 62
        return self._first_ns + (0 if self._system_id else seconds_to_ns(LISTEN_S))

    def failure(self, waited_s: float) -> HandshakeError:
        """Error of a search without result."""
        waited = f"within {waited_s:g} s"
        if not self._heard:
            return HandshakeError(self._device, f"nothing was heard {waited}", self._advice())
        if not any(reader.messages for reader in self._readers.values()):
            happened = f"{self._heard} bytes were heard {waited}, and no MAVLink among them"
            return HandshakeError(self._device, happened, "look at baud and at what is connected there")
        if not self._others:
            return HandshakeError(
                self._device, f"no heartbeat was heard {waited}", "let the autopilot send HEARTBEAT on this port"
            )
        there = ", ".join(f"system {each} ({self._others[each]})" for each in sorted(self._others))
        if self._system_id:
            happened = f"system {self._system_id} was not heard {waited}, only {there}"
            return HandshakeError(self._device, happened, "set system_id to that of the vehicle, or switch the vehicle on")
        return HandshakeError(self._device, f"no vehicle was heard {waited}, only {there}", "switch the vehicle on")

    def _take(self, heartbeat: Message, source: str, now_ns: int) -> None:
        sender = sender_of(heartbeat)
        if not is_autopilot(heartbeat) or self._system_id not in (0, sender.system):
            if len(self._others) < READERS:
                self._others[sender.system] = type_name(heartbeat.type)
            return
        self._found[sender, source] = heartbeat
        self._first_ns = self._first_ns or now_ns

    def _peer(self, sender: Sender, source: str, heartbeat: Message) -> Peer:
        announced = KINDS.get(heartbeat.autopilot)
        kind = self._kind or announced
        if kind is None:
            happened = f"the autopilot of system {sender.system} is neither PX4 nor ArduPilot (number {heartbeat.autopilot})"
            raise HandshakeError(self._device, happened, 'if it behaves like one of them, set autopilot = "px4" or "ardupilot"')
        if announced not in (None, kind):
            happened = f'system {sender.system} says that its autopilot is "{announced}", not "{kind}"'
            raise HandshakeError(self._device, happened, 'correct the parameter autopilot, or leave it at "auto"')
        if heartbeat.type not in COPTERS | GROUND:
            happened = f"system {sender.system} is of type {type_name(heartbeat.type)}"
            raise HandshakeError(self._device, happened, "this driver is for multicopters, helicopters, rovers and boats")
        autopilot = autopilot_of(kind, heartbeat.type)
        return Peer(sender=sender, source=source, vehicle_type=heartbeat.type, autopilot=autopilot, heartbeat=heartbeat)

    def _advice(self) -> str:
        if self._device.startswith("udpin"):
            return "let the autopilot, its simulator or a MAVLink router send to this port"
        if ":" in self._device:
            return "is the vehicle or its simulator running, and is this its port?"
        return "look at battery and cable, and at baud (often 57600 for radios, 115200 or 921600 for companion ports)"


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:-1])) + f" and {numbers[-1]}"
