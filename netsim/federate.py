"""The radio in the simulation: positions and sent messages in, receptions and frame reports out."""

from collections.abc import Sequence

from cosim.federate import Event, RunInfo, Slot, Step
from cosim.types import Message, Reception, States
from netsim.channel import Channel


class RadioFederate:
    """One federate for all links.

    ====================  =========  ===============================================================================
    key                   direction  value
    ====================  =========  ===============================================================================
    ``world/states``      in         `States`: where everybody is; the newest counts
    ``<vehicle>/send``    in         `Message`: enters the channel at the event's time
    ``radio/frame``       out        `FrameReport`: what becomes of the frame at each receiver, known at its sending
    ``<vehicle>/heard``   out        `Reception`, at the time at which it arrives
    ====================  =========  ===============================================================================
    """

    name = "radio"
    slot = Slot.RADIO
    wake_slot = Slot.SEND
    reads: tuple[str, ...] = ("*/send",)
    latest: tuple[str, ...] = ("world/states",)
    wakes: tuple[str, ...] = ("*/send",)

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._states: States | None = None

    def start(self, run: RunInfo) -> int | None:
        """Begin with an idle channel; nothing to do until a message is sent."""
        self._channel.start(run.seed)
        self._states = None
        return None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Send what was handed over, in that order. Receptions lie in the future: no wake-up is needed for them."""
        events: list[Event] = []
        for event in inbox:
            if isinstance(event.value, States):
                self._states = event.value
            elif isinstance(event.value, Message):
                events += self._transmit(event.time_ns, event.value)
        return Step(events)

    def close(self) -> None:
        """Nothing to release."""

    def _transmit(self, sent_ns: int, message: Message) -> list[Event]:
        if self._states is None:
            raise ValueError(f"{message.sender} sends before any position is known (world/states)")
        report = self._channel.transmit(sent_ns, message, self._states.names, self._states.position)
        events = [Event("radio/frame", sent_ns, report)]
        rows = zip(report.receivers, report.rssi_dbm.tolist(), report.received_ns.tolist(), strict=True)
        for receiver, rssi_dbm, received_ns in rows:
            if received_ns >= 0:
                reception = Reception(message=message, rssi_dbm=rssi_dbm, sent_ns=sent_ns, received_ns=received_ns)
                events.append(Event(f"{receiver}/heard", received_ns, reception))
        return events
