"""The channel: from a message that is handed over to what becomes of it at every receiver.

::

    queue -> access (mac) -> time on the air (phy) -> level (path loss, walls, shadowing, fading) -> SINR, packet errors (phy)
          -> jammers, losses, delays -> received, or lost with a cause

With the mac ``ideal`` the fate of a frame is known when it is sent. With one that contends for the air it is known when the
frame ends, after whatever else was sent meanwhile: `Channel.next_ns` says when that will be.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.bulk import Bulk, BulkMedium
from vcmvsp.netsim.channel.contention import Contention
from vcmvsp.netsim.channel.frames import FrameBatch, SentFrame, Transmitter
from vcmvsp.netsim.channel.link_budget import AT_ONCE, Budgets, ReceiverModel
from vcmvsp.netsim.channel.reception import OnAir, Outcomes
from vcmvsp.netsim.channel.runtime_changes import RuntimeChanges
from vcmvsp.netsim.channel.rx_power import RxPower, all_endured, endured
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.impairments.jammer import Jammer
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import Delay, Fading, Floats, Loss, PathLoss, Phy, SenderLinks, unless_nothing
from vcmvsp.netsim.interfaces.medium import Hastened
from vcmvsp.netsim.interfaces.radio import Radio
from vcmvsp.netsim.mac.ideal import Ideal, Mac, needs


class Channel:
    """All links between all vehicles.

    Args:
        path_loss, walls, shadowing, fading, phy, mac, script, trace, jammer, loss, delay, delivery: the layers; None is a
            layer that does nothing.
        radios: what vehicles have of their own; the antenna of one that is not named is at its position.
    """

    def __init__(
        self,
        *,
        path_loss: PathLoss,
        phy: Phy,
        loss: Loss,
        delay: Delay,
        walls: PathLoss | None = None,
        shadowing: PathLoss | None = None,
        fading: Fading | None = None,
        mac: Mac | None = None,
        script: Script | None = None,
        trace: Trace | None = None,
        jammer: Jammer | None = None,
        delivery: Delivery | None = None,
        radios: Mapping[str, Radio] | None = None,
    ) -> None:
        self.phy, self.mac = phy, mac or Ideal()
        least = needs(self.mac, phy)
        own = dict(radios or {})
        if least.sensitivity_dbm == -np.inf and any(radio.sensitivity_dbm is not None for radio in own.values()):
            problem = f"{type(self.mac).__name__} notices frames by their SINR: a vehicle's sensitivity_dbm says nothing"
            raise ScenarioError(problem, key="mac.kind")
        layers = unless_nothing(walls), unless_nothing(shadowing)
        self.budgets = Budgets(path_loss, *layers, phy, own, least.sensitivity_dbm)
        self.hearing = ReceiverModel(phy, least.preamble_snr_db)
        self.fading, self._script, self._trace, self._jammer, self._delivery = fading, script, trace, jammer, delivery
        self._levels = RxPower(fading, script, trace)
        self.operated = RuntimeChanges(loss=loss, delay=delay)
        self.start(seed=0)

    def start(self, seed: int) -> None:
        """Forget all frames and draw from ``seed`` from now on."""
        self._seed = seed
        self._frames = 0
        self._expected: int | None = None
        self._names: tuple[str, ...] = ()
        self._senders: dict[str, Transmitter] = {}
        self._contention: Contention | None = None
        self.budgets.start()
        self.operated.start()
        self._outcomes = self._behind()

    @property
    def contends(self) -> bool:
        """Whether radios share the air, so that a frame's fate is known only when it ends."""
        return not isinstance(self.mac, Ideal)

    def expect(self, frames: int) -> None:
        """About so many frames will be sent: what pays for many only is made ready, now, or never. Changes no result."""
        self._expected = frames
        medium = self.mac.open(self.phy, 2, np.zeros(2, np.uint64), self.hearing.noise_mw)  # none of the run's
        if medium is not None:
            medium.expect(frames)

    def foresee(self, frames: int) -> None:
        """By the look of it so many more frames will be sent. Changes no result."""
        if self._contention is not None and isinstance(self._contention.medium, Hastened):
            self._contention.medium.foresee(frames)

    def send(
        self, sent_ns: int, message: Message, names: tuple[str, ...], position: Floats, *, handover_ns: int = 0
    ) -> list[FrameReport]:
        """Hand over one message.

        Args:
            sent_ns: now; must not decrease from call to call.
            message: what is sent, by whom, to whom.
            names: the vehicles, in the order in which receivers are reported.
            position: where they are, (len(names), 3) m, world; they are taken to stay there until the frame has arrived.
                The same array object means the same places.
            handover_ns: how much later it reaches the queue of its radio.

        Returns:
            The report of this frame, if its fate is known already.
        """
        self._meet_if_new(names)
        sender = self._sender(message.sender)
        air_ns = self._air_time_ns(message.size_bytes)
        mean, meant = self.budgets.mean(sender.links, names, position), sender.meant(message.to)
        sent = SentFrame(self._frames, sender, sender.frames, message, meant, sent_ns, air_ns, mean, mean.level_dbm)
        sender.frames += 1
        self._frames += 1
        if self._contention is not None:
            answerer = None if message.to is None else self._sender(message.to)
            self._contention.offer(sent, sent_ns + handover_ns, answerer)
            return []
        start_ns = max(sent_ns + handover_ns, sender.free_ns)
        self._levels.set(sent, start_ns)
        heard = self.hearing.hear(mean, sent.level_dbm, message.size_bytes)
        end_ns = start_ns + air_ns
        return [self._report(sent, OnAir(endured(sent, heard), start_ns, end_ns, heard.snr_db, heard.snr_db))]

    def send_all(
        self, sent_ns: int, messages: Sequence[Message], names: tuple[str, ...], position: Floats
    ) -> list[FrameReport] | None:
        """Hand over one message each of several vehicles: what `send` says of one after the other, in much less time.

        Returns:
            The reports of the frames; None if they have to be sent one by one: where radios share the air, a layer has a say
            in single frames, or a message is for one vehicle alone.
        """
        self._meet_if_new(names)
        alone = self._contention is None and not self._levels.vary and self._jammer is None
        if not (alone and self.budgets.by_distance and self._outcomes.by_draws):
            return None
        different = len({message.sender for message in messages}) == len(messages) <= AT_ONCE / len(names)
        if not different or any(message.to is not None for message in messages):
            return None
        senders = [self._sender(message.sender) for message in messages]
        air_ns = [self._air_time_ns(message.size_bytes) for message in messages]
        every = self.budgets.together([sender.links for sender in senders], names, position)
        heard = self.hearing.hear_together(every, [message.size_bytes for message in messages])
        ends = [max(sent_ns, sender.free_ns) + air for sender, air in zip(senders, air_ns, strict=True)]
        numbers = [sender.frames for sender in senders]
        chorus = FrameBatch(self._frames, sent_ns, senders, list(messages), numbers, air_ns, ends, every, heard)
        reports = self._outcomes.reports(chorus, all_endured(chorus))
        self._frames += len(messages)
        for sender, end_ns in zip(senders, ends, strict=True):
            sender.frames += 1
            sender.free_ns = end_ns
        return reports

    def skip(self, sender: str) -> int:
        """Count a frame of which somebody else says what becomes of it, and give its number; it is never on the air here."""
        self._senders.setdefault(sender, Transmitter()).frames += 1
        self._frames += 1
        return self._frames - 1

    def bulk(self, names: tuple[str, ...], position: Floats) -> Bulk | None:
        """For many broadcasts of vehicles that stand still; None if layers have a say in single frames."""
        if self._frames:
            raise ValueError("frames have been sent one by one: start anew")
        self._meet(names)
        plain = not self._levels.vary and self._jammer is None and self._outcomes.plain
        medium = None if self._contention is None else self._contention.medium
        if not plain or not isinstance(medium, BulkMedium):
            return None
        links = [self._sender(name).links for name in names]
        means = [self.budgets.mean(each, names, position) for each in links]
        return Bulk(medium, links, means, [self.hearing.weakness(mean) for mean in means])

    def advance(self, until_ns: int) -> list[FrameReport]:
        """Report all frames whose fate is decided up to ``until_ns``."""
        if self._contention is None:
            return []
        return [self._report(sent, air) for sent, air in self._contention.advance(until_ns)]

    def next_ns(self) -> int | None:
        """Before this no frame is decided, as long as nothing else is sent; None: none is waiting."""
        return None if self._contention is None else self._contention.next_ns()

    def finish(self) -> list[FrameReport]:
        """Report the frames that were handed over and are not decided yet, as under way."""
        waiting = () if self._contention is None else self._contention.waiting.values()
        self._contention, self._names = None, ()
        return [self._outcomes.unfinished(sent) for sent in waiting]

    def levels_dbm(self, names: tuple[str, ...], position: Floats) -> Floats:
        """The mean level of each radio, by row, at each other, by column, (n, n) dBm; NaN at itself. Arguments as of `send`."""
        self._meet_if_new(names)
        levels = np.full((len(names), len(names)), np.nan)
        for sender in map(self._sender, names):
            levels[sender.row, sender.others] = self.budgets.mean(sender.links, names, position).level_dbm
        return levels

    def close(self) -> None:
        """Nothing to release."""

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Lose every frame from and to these vehicles that is on the air at any time of ``[from_ns, until_ns)``.

        Frames whose fate is decided already are none of them, and all fare on the air as they would.
        """
        self.operated.cut_off(vehicles, from_ns, until_ns)
        self._outcomes = self._behind()

    def change(self, key: str, value: float) -> None:
        """Give a number of a layer (`RuntimeChanges.numbers`) another value, for all frames whose fate is still open."""
        self.operated.change(key, value)
        self._outcomes = self._behind()

    def _behind(self) -> Outcomes:
        """What is behind reception, as it is now."""
        now = self.operated.layers
        loss, delay, outages = map(unless_nothing, (now["loss"], now["delay"], self.operated.outages))
        layers = loss, delay, self._script, self._trace, self._delivery
        return Outcomes(self.hearing, *layers, fades=self.fading is not None, outages=outages)

    def _meet_if_new(self, names: tuple[str, ...]) -> None:
        if names is not self._names and names != self._names:
            self._meet(names)

    def _meet(self, names: tuple[str, ...]) -> None:
        if self._contention is not None and self._contention.waiting:
            raise ValueError(f"the vehicles changed while frames were under way: {', '.join(names)}")
        self._names = names
        medium = self.mac.open(self.phy, len(names), SenderLinks(self._seed, "", names).keys, self.hearing.noise_mw)
        if medium is not None and self._expected is not None:
            medium.expect(self._expected)
        self._contention = None
        if medium is not None:
            self._contention = Contention(medium, names, self.budgets, self.hearing, self._levels)
        if self._delivery is not None:
            self._delivery.open(len(names))

    def _sender(self, name: str) -> Transmitter:
        found = self._senders.get(name)
        if found is None:
            found = self._senders[name] = Transmitter()
        if found.names is not self._names:
            if name not in self._names:
                raise ValueError(f"{name} sends, but its position is unknown; known: {', '.join(self._names) or 'none'}")
            found.meet(SenderLinks(self._seed, name, tuple(each for each in self._names if each != name)), self._names)
        return found

    def _air_time_ns(self, size_bytes: int) -> int:
        air_ns = self.phy.air_time_ns(size_bytes)
        if air_ns < 1:
            raise ValueError(f"{type(self.phy).__name__}.air_time_ns({size_bytes}) is {air_ns}: must be at least 1 ns")
        return air_ns

    def _report(self, sent: SentFrame, air: OnAir) -> FrameReport:
        interference_mw = None
        if self._jammer is not None and air.start_ns >= 0:
            mean, gain_dbi = sent.mean, self.budgets.gain_dbi(sent.sender.links.receivers)
            interference_mw = self._jammer.interference_mw(
                air.start_ns,
                air.end_ns,
                mean.paths.rx,
                lambda tx, rx: self.budgets.loss_db(tx, rx) - gain_dbi,
                lambda name: mean.antennas[self._names.index(name)],
            )
        return self._outcomes.report(sent, air, interference_mw)
