"""The channel: from a message that is handed over to what becomes of it at every receiver.

::

    queue -> access (mac) -> time on the air (phy) -> level (path loss, walls, shadowing, fading) -> SINR, packet errors (phy)
          -> jammers, losses, delays -> received, or lost with a cause

With the mac ``ideal`` the fate of a frame is known when it is sent. With one that contends for the air it is known when the
frame ends, after whatever else was sent meanwhile: `Channel.next_ns` says when that will be.
"""

from collections.abc import Mapping, Sequence
from heapq import heappop, heappush

import numpy as np

from cosim.errors import ScenarioError
from cosim.rng import link_uniform
from cosim.types import FrameReport, Message
from netsim.budget import AT_ONCE, Budgets, Hearing
from netsim.budget_mean import Heard, at_all
from netsim.bulk import Bulk, BulkMedium
from netsim.delivery import Delivery
from netsim.draws import ERROR_SLOT, FADING_SLOT, RETRY_FADING_SLOT, SCRIPT_SLOT
from netsim.jammer import Jammer
from netsim.layers import Delay, Fading, Floats, Links, Loss, PathLoss, Phy, sealed, unless_nothing
from netsim.mac import Ideal, Mac, needs
from netsim.medium import Codes, Decided, Fate, Hastened, Levelled, Medium, Offered, Powered
from netsim.operated import Operated
from netsim.outcome import OnAir, Outcomes
from netsim.radios import Radio
from netsim.script import Script
from netsim.sending import Chorus, Sender, Sent
from netsim.trace import Trace


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
        self.hearing = Hearing(phy, least.preamble_snr_db)
        self.fading, self._script, self._trace, self._jammer, self._delivery = fading, script, trace, jammer, delivery
        self._varies = any(layer is not None for layer in (fading, script, trace))  # levels, from attempt to attempt
        self.operated = Operated(loss=loss, delay=delay)
        self.start(seed=0)

    def start(self, seed: int) -> None:
        """Forget all frames and draw from ``seed`` from now on."""
        self._seed = seed
        self._frames = 0
        self._expected: int | None = None
        self._names: tuple[str, ...] = ()
        self._senders: dict[str, Sender] = {}
        self._medium: Medium | None = None
        self._levelled: Levelled | None = None  # the medium, if it is one
        self._waiting: dict[int, Sent] = {}  # by frame: those that contend
        self._answers: dict[int, Floats] = {}  # by frame: levels of who acknowledges it, until it is offered
        self._coming: list[tuple[int, int, Offered]] = []  # heap of (time, frame): those of them on their way to the radio
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
        if isinstance(self._medium, Hastened):
            self._medium.foresee(frames)

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
        sent = Sent(self._frames, sender, sender.frames, message, meant, sent_ns, air_ns, mean, mean.level_dbm)
        sender.frames += 1
        self._frames += 1
        if self._medium is not None:
            self._offer(sent, sent_ns + handover_ns)
            return []
        start_ns = max(sent_ns + handover_ns, sender.free_ns)
        self._set_level(sent, start_ns)
        heard = self.hearing.hear(mean, sent.level_dbm, message.size_bytes)
        end_ns = start_ns + air_ns
        return [self._report(sent, OnAir(self._endure(sent, heard), start_ns, end_ns, heard.snr_db, heard.snr_db))]

    def send_all(
        self, sent_ns: int, messages: Sequence[Message], names: tuple[str, ...], position: Floats
    ) -> list[FrameReport] | None:
        """Hand over one message each of several vehicles: what `send` says of one after the other, in much less time.

        Returns:
            The reports of the frames; None if they have to be sent one by one: where radios share the air, a layer has a say
            in single frames, or a message is for one vehicle alone.
        """
        self._meet_if_new(names)
        alone = self._medium is None and not self._varies and self._jammer is None
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
        chorus = Chorus(self._frames, sent_ns, senders, list(messages), numbers, air_ns, ends, every, heard)
        reports = self._outcomes.reports(chorus, self._endure_all(chorus))
        self._frames += len(messages)
        for sender, end_ns in zip(senders, ends, strict=True):
            sender.frames += 1
            sender.free_ns = end_ns
        return reports

    def skip(self, sender: str) -> int:
        """Count a frame of which somebody else says what becomes of it, and give its number; it is never on the air here."""
        self._senders.setdefault(sender, Sender()).frames += 1
        self._frames += 1
        return self._frames - 1

    def bulk(self, names: tuple[str, ...], position: Floats) -> Bulk | None:
        """For many broadcasts of vehicles that stand still; None if layers have a say in single frames."""
        if self._frames:
            raise ValueError("frames have been sent one by one: start anew")
        self._meet(names)
        plain = not self._varies and self._jammer is None and self._outcomes.plain
        if not plain or not isinstance(self._medium, BulkMedium):
            return None
        links = [self._sender(name).links for name in names]
        means = [self.budgets.mean(each, names, position) for each in links]
        return Bulk(self._medium, links, means, [self.hearing.weakness(mean) for mean in means])

    def advance(self, until_ns: int) -> list[FrameReport]:
        """Report all frames whose fate is decided up to ``until_ns``."""
        if self._medium is None or not self._waiting:
            return []
        decided: list[Decided] = []
        while self._coming and self._coming[0][0] <= until_ns:
            offered = heappop(self._coming)[2]
            if offered.to >= 0 and self._levelled is not None:  # not before its time: others may be answering still
                decided += self._medium.advance(offered.time_ns)
                self._levelled.levels[offered.to] = self._answers.pop(offered.number)
            self._medium.offer(offered)
        decided += self._medium.advance(until_ns)
        return [self._settle(each) for each in decided]

    def next_ns(self) -> int | None:
        """Before this no frame is decided, as long as nothing else is sent; None: none is waiting."""
        if self._medium is None or not self._waiting:
            return None
        times = [arrival_ns for arrival_ns, _, _ in self._coming[:1]]  # where it may find no room
        due = self._medium.next_ns()
        return min(times if due is None else [*times, due])

    def finish(self) -> list[FrameReport]:
        """Report the frames that were handed over and are not decided yet, as under way."""
        waiting, self._waiting, self._coming, self._answers = list(self._waiting.values()), {}, [], {}
        self._medium, self._levelled, self._names = None, None, ()
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
        """Give a number of a layer (`Operated.numbers`) another value, for all frames whose fate is still open."""
        self.operated.change(key, value)
        self._outcomes = self._behind()

    def _behind(self) -> Outcomes:
        """What is behind reception, as it is now."""
        loss, delay, outages = map(unless_nothing, (*self.operated.layers.values(), self.operated.outages))
        layers = loss, delay, self._script, self._trace, self._delivery
        return Outcomes(self.hearing, *layers, fades=self.fading is not None, outages=outages)

    def _meet_if_new(self, names: tuple[str, ...]) -> None:
        if names is not self._names and names != self._names:
            self._meet(names)

    def _meet(self, names: tuple[str, ...]) -> None:
        if self._waiting:
            raise ValueError(f"the vehicles changed while frames were under way: {', '.join(names)}")
        self._names = names
        self._medium = self.mac.open(self.phy, len(names), Links(self._seed, "", names).keys, self.hearing.noise_mw)
        if self._medium is not None and self._expected is not None:
            self._medium.expect(self._expected)
        self._levelled = self._medium if isinstance(self._medium, Levelled) else None
        if self._levelled is not None:
            self._levelled.sensitivity_mw[:] = 10.0 ** (self.budgets.sensitivity_dbm(names) / 10.0)
        if isinstance(self._medium, Powered):
            self._medium.power_mw[:] = 10.0 ** (self.budgets.tx_power_dbm(names) / 10.0)
        if self._delivery is not None:
            self._delivery.open(len(names))

    def _sender(self, name: str) -> Sender:
        found = self._senders.get(name)
        if found is None:
            found = self._senders[name] = Sender()
        if found.names is not self._names:
            if name not in self._names:
                raise ValueError(f"{name} sends, but its position is unknown; known: {', '.join(self._names) or 'none'}")
            found.meet(Links(self._seed, name, tuple(each for each in self._names if each != name)), self._names)
        return found

    def _air_time_ns(self, size_bytes: int) -> int:
        air_ns = self.phy.air_time_ns(size_bytes)
        if air_ns < 1:
            raise ValueError(f"{type(self.phy).__name__}.air_time_ns({size_bytes}) is {air_ns}: must be at least 1 ns")
        return air_ns

    # --- from a message to its fate -----------------------------------------------------------------------------------------

    def _set_level(self, sent: Sent, start_ns: int) -> None:
        """The level of an attempt to send a frame, where it is another one than the mean."""
        if not self._varies:
            return
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        level_dbm = sent.mean.level_dbm
        if self.fading is not None:
            slot = RETRY_FADING_SLOT + sent.attempts if sent.attempts > 1 else FADING_SLOT
            sent.fading_db = self.fading.gain_db(frame, sent.draw(slot))
            level_dbm = level_dbm + sent.fading_db
        if self._trace is not None:
            traced_dbm = self._trace.level_dbm(frame)
            level_dbm = np.where(np.isnan(traced_dbm), level_dbm, traced_dbm)
        if self._script is not None:
            level_dbm = level_dbm + self._script.gain_db(frame, sent.draw(SCRIPT_SLOT))
        sent.level_dbm = level_dbm

    def _endure(self, sent: Sent, heard: Heard) -> Codes:
        """The fate of a frame that no other disturbs, (n,)."""
        fate, doubtful = heard.fate, heard.doubtful
        if doubtful.size and heard.hazard is not None:
            uniform = sent.sender.draws.some(sent.number, ERROR_SLOT, doubtful)[:, 0]
            fate = fate.copy()
            fate[doubtful[-np.log1p(-uniform) <= heard.hazard[doubtful]]] = Fate.ERROR
        return fate

    def _endure_all(self, chorus: Chorus) -> Codes:
        """The same of several frames, (k, n)."""
        fate, hazard = chorus.heard.fate, chorus.heard.hazard
        if hazard is None or not (where := chorus.heard.in_doubt.nonzero())[0].size:
            return fate
        keys = np.stack([sender.links.keys for sender in chorus.senders])[where]
        uniform = link_uniform(keys, np.array(chorus.numbers, np.uint64)[where[0]], ERROR_SLOT)[:, 0]
        lost = -np.log1p(-uniform) <= hazard[where]
        fate = fate.copy()
        fate[where[0][lost], where[1][lost]] = Fate.ERROR
        return fate

    def _offer(self, sent: Sent, arrival_ns: int) -> None:
        row = sent.sender.row

        def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
            sent.attempts = attempt + 1
            patience = at_all(sent.sender.draws.patience(sent.number, ERROR_SLOT + attempt), row)
            if not self._varies:
                return sent.mean.power_mw, patience
            self._set_level(sent, start_ns)
            sent.tries.append((sent.level_dbm, sent.fading_db))
            return at_all(10.0 ** (sent.level_dbm / 10.0), row), patience

        power_mw, patience = (None, None) if self._varies else renew(0, 0)
        to = -1 if sent.message.to is None else self._answerer(sent)
        self._waiting[sent.frame] = sent
        offered = Offered(
            sent.frame, arrival_ns, row, to, sent.message.size_bytes, sent.message.priority, power_mw, patience, renew
        )
        heappush(self._coming, (arrival_ns, sent.frame, offered))

    def _answerer(self, sent: Sent) -> int:
        """The row of the radio that will acknowledge, from where it is now."""
        assert sent.message.to is not None  # noqa: S101  it is asked for unicast frames
        radio = self._sender(sent.message.to)
        if self._levelled is not None:
            self._answers[sent.frame] = self.budgets.here(radio.links).power_mw
        return radio.row

    def _settle(self, decided: Decided) -> FrameReport:
        sent = self._waiting.pop(decided.number)
        if decided.attempts and sent.tries:  # there may have been another one since, because the acknowledgement was lost
            sent.level_dbm, sent.fading_db = sent.tries[decided.attempts - 1]
        others = sent.sender.others
        snr_db = sinr_db = self.hearing.over_noise(sent.level_dbm)
        if decided.attempts:
            least_sinr = decided.least_sinr[others]
            least_sinr[least_sinr <= 0.0] = np.nan  # no ratio at a radio that was sending itself
            sinr_db = sealed(10.0 * np.log10(least_sinr))
        return self._report(sent, OnAir(decided.fate[others], decided.start_ns, decided.end_ns, snr_db, sinr_db))

    def _report(self, sent: Sent, air: OnAir) -> FrameReport:
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
