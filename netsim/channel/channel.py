"""The channel: from a message to its outcome at every receiver.

::

    queue -> access (mac) -> time on the air (phy) -> level (path loss, walls, shadowing, fading) -> SINR, packet errors (phy)
          -> jammers, losses, delays -> received, or lost with a cause

With the mac ``ideal`` the outcome of a frame is known when it is sent. With contention it is known when the frame ends:
`Channel.next_ns` is the time of the next one. Frames pass the stages behind the medium in batches; a single frame is a batch of
one.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.cosim.vehicle_clock import VehicleClock
from vcmvsp.netsim.channel.frames import Contention, FrameBatch, RxPower, SentFrame, Transmitter, decode
from vcmvsp.netsim.channel.link_budget import AT_ONCE, Budgets, MeanBudget, ReceiverModel
from vcmvsp.netsim.channel.reception import Bulk, Outcomes
from vcmvsp.netsim.channel.replayed import RecordedFrames
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.impairments.jammer import Jammer
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import (
    Bools,
    Delay,
    Draw,
    Fading,
    Floats,
    Frame,
    Loss,
    PathLoss,
    Phy,
    Radio,
    SenderLinks,
    unless_nothing,
)
from vcmvsp.netsim.interfaces.medium import Ideal, Mac, Medium, thresholds
from vcmvsp.netsim.mac.tdma import Tdma


@dataclass(frozen=True)
class Outages:
    """Losses of every frame from and to some vehicles that is on the air at any time of ``[from_ns, until_ns)``."""

    spans: tuple[tuple[frozenset[str], int, int], ...] = ()  # vehicles, from_ns, until_ns
    cause: ClassVar[str] = "outage"

    @property
    def nothing(self) -> bool:
        """Whether there was no outage yet."""
        return not self.spans

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        present = [names for names, begin, end in self.spans if begin < frame.end_ns and frame.start_ns < end]
        cut_off = frozenset().union(*present)
        return np.array([frame.sender in cut_off or receiver in cut_off for receiver in frame.receivers], np.bool_)


class RuntimeChanges:
    """The current layers, and the outages so far.

    Numeric fields of layers that are dataclasses may change; keys are as in the scenario: ``radio.loss.probability``.

    Attributes:
        table: the scenario's table of the layers.
    """

    table = "radio"

    def __init__(self, **layers: Any) -> None:
        self._first: Mapping[str, Any] = layers
        self.start()

    def start(self) -> None:
        """Undo all changes and outages."""
        self.layers, self.outages = self._first, Outages()

    def numbers(self) -> dict[str, float]:
        """Keys and values of the numbers that may change."""
        numbers: dict[str, float] = {}
        for name, layer in self.layers.items():
            parameters = _parameters(layer) if dataclasses.is_dataclass(layer) else {}
            numbers |= {f"{self.table}.{name}.{key}": value for key, value in parameters.items() if type(value) in (int, float)}
        return numbers

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Lose every frame from and to these vehicles."""
        self.outages = Outages((*self.outages.spans, (frozenset(vehicles), from_ns, until_ns)))

    def check(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Check a change after earlier ones without making it; see `changed`."""
        layers = self.layers
        for before in (*earlier, (key, value)):
            layers = self.changed(layers, *before)

    def changed(self, layers: Mapping[str, Any], key: str, value: float) -> dict[str, Any]:
        """The layers with one number changed.

        Raises:
            ValueError: unknown key, or invalid value.
        """
        if key not in self.numbers():
            raise ValueError(f"{key} cannot change during a run; keys that can: {', '.join(self.numbers()) or 'none'}")
        name, parameter = key.removeprefix(f"{self.table}.").split(".")
        layer = layers[name]
        rest = {name: value for name, value in _parameters(layer).items() if name != parameter}
        try:
            new = binding.call(type(layer), {parameter: value}, key=f"{self.table}.{name}", arguments=rest)
        except ScenarioError as error:
            raise ValueError(str(error)) from error
        return {**layers, name: new}


class Channel:
    """All links between all vehicles.

    Args:
        path_loss, walls, shadowing, fading, phy, mac, script, trace, jammer, loss, delay, delivery: the layers; None: no such
            layer.
        radios: by vehicle; without an entry the antenna is at the position of the vehicle.
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
        least_dbm, preamble_db = thresholds(self.mac, phy)
        own = dict(radios or {})
        if least_dbm == -np.inf and any(radio.sensitivity_dbm is not None for radio in own.values()):
            problem = f"{type(self.mac).__name__} detects frames by their SINR: a vehicle's sensitivity_dbm has no effect"
            raise ScenarioError(problem, key="mac.kind")
        layers = unless_nothing(walls), unless_nothing(shadowing)
        self.budgets = Budgets(path_loss, *layers, phy, own, least_dbm)
        self.hearing = ReceiverModel(phy, preamble_db)
        self.fading, self._script, self._trace, self._jammer, self._delivery = fading, script, trace, jammer, delivery
        self._levels = RxPower(fading, script, trace)
        self.operated = RuntimeChanges(loss=loss, delay=delay)
        self.recorded: RecordedFrames | None = None  # source of the outcomes of recorded frames; all others are drawn
        self.start(seed=0)

    def start(self, seed: int, clocks: Mapping[str, VehicleClock] | None = None) -> None:
        """Start a run: no frames, draws from ``seed``; ``clocks``: of vehicles that do not have the run's time."""
        self._seed, self._clocks = seed, clocks or {}
        self._frames = 0
        self._expected: int | None = None
        self._names: tuple[str, ...] = ()
        self._senders: dict[str, Transmitter] = {}
        self._contention: Contention | None = None
        self.budgets.start()
        self.operated.start()
        if self.recorded is not None:
            self.recorded.start()
        self._outcomes = self._behind()

    @property
    def contends(self) -> bool:
        """Whether radios contend for the medium, so that outcomes are known only when frames end."""
        return not isinstance(self.mac, Ideal)

    @property
    def unbatchable(self) -> str:
        """What prevents this channel from being computed for many worlds at once, in words; empty: nothing."""
        if self.contends:
            return f"mac.kind: radios contend ({type(self.mac).__name__})"
        if not self.budgets.by_distance:
            return "path_loss, walls, shadowing: the level depends on more than the distance"
        layers = {"script": self._script, "trace": self._trace, "jammer": self._jammer, "delivery": self._delivery}
        return next((name for name, layer in layers.items() if unless_nothing(layer) is not None), "")

    def expect(self, frames: int) -> None:
        """Hint of the number of frames; decides now whether to compile. Changes no result."""
        self._expected = frames
        for layer in (self.budgets.path_loss, self.fading):
            getattr(layer, "prepare", lambda: None)()
        medium = self.mac.open(self.phy, 2, np.zeros(2, np.uint64), self.hearing.noise_mw)  # a temporary medium
        if medium is not None:
            medium.expect(frames)

    def foresee(self, frames: int) -> None:
        """Hint of the number of further frames. Changes no result."""
        medium: Any = None if self._contention is None else self._contention.medium
        if hasattr(medium, "foresee"):
            medium.foresee(frames)

    def send(
        self,
        sent_ns: int,
        message: Message,
        names: tuple[str, ...],
        position: Floats,
        *,
        attitude: Floats | None = None,
        handover_ns: int = 0,
    ) -> list[FrameReport]:
        """Hand over one message.

        Args:
            sent_ns: now; must not decrease from call to call.
            message: with sender and destination.
            names: all vehicles, in the order of the receivers in reports.
            position: of the vehicles, (len(names), 3) m, world, until the frame has arrived. The same array object means the
                same positions.
            attitude: of the vehicles, (len(names), 4), world_from_body, for antennas that turn; None: all are level.
            handover_ns: delay until the frame reaches the queue of its radio.

        Returns:
            The report of this frame, if it is decided already.
        """
        if self.recorded is not None:
            sender = self._senders.setdefault(message.sender, Transmitter())
            report = self.recorded.report(message, names, sender.frames, self._frames, sent_ns)
            if report is not None:
                sender.frames += 1
                self._frames += 1
                return [report]
        self._meet_if_new(names)
        sender = self._sender(message.sender)
        self.budgets.turn(attitude)
        sent = self._frame(sent_ns, message, sender, self.budgets.mean(sender.links, names, position))
        self.budgets.note_enclosed()
        if self._contention is not None:
            acknowledger = None if message.to is None else self._sender(message.to)
            self._contention.offer(sent, sent_ns + handover_ns, acknowledger)
            return []
        start_ns = max(sent_ns + handover_ns, sent.sender.free_ns)
        self._levels.set(sent, start_ns)
        return self._send_now([sent], [start_ns])

    def send_all(
        self, sent_ns: int, messages: Sequence[Message], names: tuple[str, ...], position: Floats
    ) -> list[FrameReport] | None:
        """Hand over one message each of several vehicles in one batch, with the same result as `send` one by one.

        Returns:
            The reports of the frames; None if no batch is possible: radios contend, levels change from frame to frame or do not
            depend on distance alone, or a vehicle sends twice.
        """
        self._meet_if_new(names)
        plain = not (self.contends or self.recorded or self._levels.vary or self._jammer) and self.budgets.by_distance
        different = len({message.sender for message in messages}) == len(messages) <= AT_ONCE / len(names)
        if not plain or not different:
            return None
        senders = [self._sender(message.sender) for message in messages]
        means = self.budgets.means([sender.links for sender in senders], names, position)
        frames = [self._frame(sent_ns, *each) for each in zip(messages, senders, means, strict=True)]
        return self._send_now(frames, [max(sent_ns, sent.sender.free_ns) for sent in frames])

    def _frame(self, sent_ns: int, message: Message, sender: Transmitter, mean: MeanBudget) -> SentFrame:
        air_ns, to = self._air_time_ns(message.size_bytes), sender.destination(message.to)
        number, frame = sender.frames, self._frames
        sender.frames += 1
        self._frames += 1
        return SentFrame(frame, sender, number, message, to, sent_ns, air_ns, mean, mean.level_dbm)

    def _send_now(self, frames: list[SentFrame], start_ns: list[int]) -> list[FrameReport]:
        means, levels_dbm, sizes = zip(*((sent.mean, sent.level_dbm, sent.message.size_bytes) for sent in frames), strict=True)
        signal = self.hearing.signals(means, levels_dbm, sizes)
        end_ns = [start + sent.air_ns for start, sent in zip(start_ns, frames, strict=True)]
        return self._reports(FrameBatch(frames, decode(frames, signal), start_ns, end_ns, signal.snr_db, signal.snr_db))

    def bulk(self, names: tuple[str, ...], position: Floats) -> Bulk | None:
        """Batched broadcasts of vehicles at rest; None if a layer acts on single frames."""
        if self._frames:
            raise ValueError("single frames were sent on this channel: use a new channel for a batch")
        self._meet(names)
        plain = not self._levels.vary and self._jammer is None and self._outcomes.plain
        medium = None if self._contention is None else self._contention.medium
        if not plain or not hasattr(medium, "offer_many"):
            return None
        senders = [self._sender(name) for name in names]
        return Bulk(medium, senders, [self.budgets.mean(each.links, names, position) for each in senders], self.hearing)

    def advance(self, until_ns: int) -> list[FrameReport]:
        """Reports of all frames that are decided up to ``until_ns``."""
        return [report for _, report in self.decisions(until_ns)]

    def decisions(self, until_ns: int) -> list[tuple[int, FrameReport]]:
        """`advance` with the time of each decision, ns."""
        if self._contention is None:
            return []
        decided: list[tuple[int, FrameReport]] = []
        for batch in self._contention.advance(until_ns):
            decided += zip(batch.end_ns, self._reports(batch), strict=True)
        return decided

    def next_ns(self) -> int | None:
        """Earliest time of the next decision if no other frame is sent; None: no frame waits."""
        return None if self._contention is None else self._contention.next_ns()

    def finish(self) -> list[FrameReport]:
        """Reports of the frames that are not decided yet, as under way."""
        waiting = () if self._contention is None else self._contention.waiting.values()
        self._contention, self._names = None, ()
        return [self._outcomes.unfinished(sent) for sent in waiting]

    def levels_dbm(self, names: tuple[str, ...], position: Floats, attitude: Floats | None = None) -> Floats:
        """Mean levels, (n, n) dBm: sender by row, receiver by column, NaN at the sender. Arguments: see `send`."""
        self._meet_if_new(names)
        self.budgets.turn(attitude)
        levels = np.full((len(names), len(names)), np.nan)
        for sender in map(self._sender, names):
            levels[sender.row, sender.others] = self.budgets.mean(sender.links, names, position).level_dbm
        return levels

    def close(self) -> None:
        """Report the number of frames that were not in the recording."""
        if self.recorded is not None:
            self.recorded.close(self._frames)

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Lose every frame from and to these vehicles that is on the air at any time of ``[from_ns, until_ns)``.

        Frames that are decided already are not changed, nor is the medium.
        """
        self.operated.cut_off(vehicles, from_ns, until_ns)
        self._outcomes = self._behind()

    def change(self, key: str, value: float) -> None:
        """Change a number of a layer (`RuntimeChanges.numbers`), for all frames that are not decided yet."""
        self.operated.layers = self.operated.changed(self.operated.layers, key, value)
        self._outcomes = self._behind()

    def _behind(self) -> Outcomes:
        """The stages behind the receiver, with the layers of now."""
        now = self.operated.layers
        loss, delay, outages = map(unless_nothing, (now["loss"], now["delay"], self.operated.outages))
        layers = loss, delay, self._script, self._trace, self._delivery
        propagation = getattr(now["delay"], "propagation", False)
        return Outcomes(self.hearing, *layers, fades=self.fading is not None, propagation=propagation, outages=outages)

    def _meet_if_new(self, names: tuple[str, ...]) -> None:
        if names is not self._names and names != self._names:
            self._meet(names)

    def _meet(self, names: tuple[str, ...]) -> None:
        if self._contention is not None and self._contention.waiting:
            raise ValueError(f"the vehicles changed while frames were on the air; now: {', '.join(names)}")
        self._names = names
        if isinstance(self.mac, Tdma):
            medium: Medium | None = self.mac.open_named(self.phy, names, self._clocks, self.hearing.noise_mw)
        else:
            medium = self.mac.open(self.phy, len(names), SenderLinks(self._seed, "", names).keys, self.hearing.noise_mw)
        if medium is not None and self._expected is not None:
            medium.expect(self._expected)
        self._contention = None
        if medium is not None:
            self._contention = Contention(medium, names, self.budgets, self.hearing, self._levels)
        if self._delivery is not None:
            self._delivery.open(len(names))

    def _sender(self, name: str) -> Transmitter:
        transmitter = self._senders.get(name)
        if transmitter is None:
            transmitter = self._senders[name] = Transmitter()
        if transmitter.names is not self._names:
            names = self._names
            if name not in names:
                raise ValueError(f"sender {name} has no position; vehicles with a position: {', '.join(names) or 'none'}")
            row = names.index(name)
            transmitter.meet(SenderLinks(self._seed, name, names[:row] + names[row + 1 :]), names)
        return transmitter

    def _air_time_ns(self, size_bytes: int) -> int:
        air_ns = self.phy.air_time_ns(size_bytes)
        if air_ns < 1:
            raise ValueError(f"{type(self.phy).__name__}.air_time_ns({size_bytes}) is {air_ns}: must be at least 1 ns")
        return air_ns

    def _reports(self, batch: FrameBatch) -> list[FrameReport]:
        if self._jammer is not None:
            rows = [self._interference_mw(self._jammer, batch, k) for k in range(len(batch.frames))]
            batch.interference_mw = np.stack(rows)
        return self._outcomes.reports(batch)

    def _interference_mw(self, jammer: Jammer, batch: FrameBatch, k: int) -> Floats:
        """Interference of jammers at the receivers of frame k, (n,) mW; 0 if the frame was never sent."""
        mean, receivers = batch.frames[k].mean, batch.frames[k].sender.links.receivers
        if batch.start_ns[k] < 0:
            return np.zeros(len(receivers))
        gain_dbi = self.budgets.gain_dbi(receivers)
        return jammer.interference_mw(
            batch.start_ns[k],
            batch.end_ns[k],
            mean.paths.rx,
            lambda tx, rx: self.budgets.loss_db(tx, rx) - gain_dbi,
            lambda name: mean.every.antennas[self._names.index(name)],
        )


def _parameters(layer: Any) -> dict[str, Any]:
    return {each.name: getattr(layer, each.name) for each in dataclasses.fields(layer) if each.init}
