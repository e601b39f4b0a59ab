"""The radio in the simulation: positions and sent messages in, receptions and frame reports out."""

from collections.abc import Sequence

import numpy as np

from cosim.clock import seconds_to_ns
from cosim.federate import Event, RunInfo, Slot, Step
from cosim.rng import stream
from cosim.types import Changed, FrameReport, Message, Outage, Reception, Seconds, States
from netsim.channel import Channel
from netsim.recorded import RecordedChannel


class RadioFederate:
    """One federate for all links.

    ====================  =========  ===============================================================================
    key                   direction  value
    ====================  =========  ===============================================================================
    ``world/states``      in         `States`: where everybody is; the newest counts
    ``<vehicle>/send``    in         `Message`: enters the channel at the event's time
    ``operator/outage``   in         `Outage`: frames whose fate is open at the event's time are lost, as far as it concerns
                                     them
    ``operator/changed``  in         `Changed`: a number of a layer, for all frames whose fate is open then
    ``radio/frame``       out        `FrameReport`: what became of a frame, as soon as that is known: at its sending where
                                     nobody contends for the air, or a recording tells it (`netsim.recorded`), else when
                                     it ends; at the end of the run for the rest
    ``<vehicle>/heard``   out        `Reception`, at the time at which it arrives
    ====================  =========  ===============================================================================

    Agents that act at the same instant hand their messages over at the same nanosecond, which no two computers do: radios that
    contend for the air would then all find it free, and collide. So, where several vehicles send at one instant, a message
    takes up to ``handover_s`` to reach the queue of its radio, uniformly distributed, in the order of its sender.

    It is stepped with the senders, and once more for every frame that ends on a contended air: nothing is polled.
    """

    name = "radio"
    slot = Slot.RADIO
    wake_slot = Slot.SEND
    reads: tuple[str, ...] = ("*/send", "operator/outage", "operator/changed")
    latest: tuple[str, ...] = ("world/states",)
    wakes: tuple[str, ...] = ("*/send",)

    def __init__(self, channel: Channel | RecordedChannel, handover_s: Seconds = 0.002) -> None:
        self._channel = channel
        self._handover_ns = seconds_to_ns(handover_s) if channel.contends else 0

    def start(self, run: RunInfo) -> int | None:
        """Begin with an idle channel; nothing to do until a message is sent."""
        self._channel.start(run.seed)
        self._end_ns = run.duration_ns
        self._states: States | None = None
        self._messages: dict[int, Message] = {}  # by frame: those whose fate is open
        self._sent = 0
        self._seed = run.seed
        self._handover: dict[str, np.random.Generator] = {}
        self._handed_ns: dict[str, int] = {}
        return None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Report what is decided by now, and hand over what was sent, in that order."""
        reports = self._obey(inbox)
        reports += self._channel.advance(now_ns)  # what happens by itself comes before what is sent at the same time
        alone = len({event.value.sender for event in inbox if isinstance(event.value, Message)}) == 1
        for event in inbox:
            if isinstance(event.value, States):
                self._states = event.value
            elif isinstance(event.value, Message):
                reports += self._send(event.time_ns, event.value, alone=alone)
        reports += self._channel.advance(now_ns)
        if now_ns == self._end_ns:
            reports += self._channel.finish()
        events = [event for report in reports for event in self._events(report, now_ns)]
        due = self._channel.next_ns()
        return Step(events, None if due is None or now_ns == self._end_ns else min(due, self._end_ns))

    def close(self) -> None:
        """Release the channel."""
        self._channel.close()

    def adjustable(self) -> dict[str, float]:
        """The keys that an operator may change while the run goes on, and what they are now: ``radio.loss.probability``."""
        return self._channel.operated.numbers()

    def check_change(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Refuse a change that cannot be made; changes nothing.

        Args:
            key: as in `adjustable`.
            value: what it is to be.
            earlier: changes that are made before it.

        Raises:
            ValueError: there is no such key, or it cannot be this.
        """
        self._channel.operated.check(key, value, earlier)

    def _obey(self, inbox: Sequence[Event]) -> list[FrameReport]:
        """Do what the operator wants, each at its own time: the reports of frames that were decided before."""
        reports: list[FrameReport] = []
        for event in inbox:
            value = event.value
            if isinstance(value, Outage | Changed):
                reports += self._channel.advance(event.time_ns - 1)
            if isinstance(value, Outage):
                self._channel.cut_off(value.vehicles, event.time_ns, value.until_ns)
            elif isinstance(value, Changed):
                self._channel.change(value.key, value.value)
        return reports

    def _send(self, sent_ns: int, message: Message, *, alone: bool) -> list[FrameReport]:
        if self._states is None:
            raise ValueError(f"{message.sender} sends before any position is known (world/states)")
        self._messages[self._sent] = message
        self._sent += 1
        after_ns = self._handed_over(message.sender, sent_ns, alone=alone) - sent_ns
        return self._channel.send(sent_ns, message, self._states.names, self._states.position, handover_ns=after_ns)

    def _handed_over(self, sender: str, sent_ns: int, *, alone: bool) -> int:
        """When a message reaches the queue of its radio."""
        if not self._handover_ns:
            return sent_ns
        if sender not in self._handover:
            self._handover[sender] = stream(self._seed, f"radio/{sender}/handover")
        wait_ns = int(self._handover[sender].random() * self._handover_ns)
        at_ns = sent_ns if alone else sent_ns + wait_ns
        self._handed_ns[sender] = max(at_ns, self._handed_ns.get(sender, 0))
        return self._handed_ns[sender]

    def _events(self, report: FrameReport, now_ns: int) -> list[Event]:
        message = self._messages.pop(report.frame)
        events = [Event("radio/frame", now_ns, report)]
        times = [report.received_ns] if report.copy_ns is None else [report.received_ns, report.copy_ns]
        for arrival_ns in times:
            for receiver, rssi_dbm, at_ns in zip(report.receivers, report.rssi_dbm.tolist(), arrival_ns.tolist(), strict=True):
                if at_ns >= 0:
                    heard = Reception(message=message, rssi_dbm=rssi_dbm, sent_ns=report.sent_ns, received_ns=at_ns)
                    events.append(Event(f"{receiver}/heard", at_ns, heard))
        return events
