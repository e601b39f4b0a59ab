"""Senders, and messages on their way."""

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Message
from vcmvsp.netsim.channel.mean_budget import BatchBudget, MeanBudget, ReceivedSignal
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Frame, SenderLinks
from vcmvsp.netsim.interfaces.link_draws import LinkDraws, Make


class Transmitter:
    """What a transmitter remembers from frame to frame."""

    links: SenderLinks
    draws: LinkDraws
    row: int  # among the vehicles
    others: NDArray[np.intp]  # rows of the others

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()  # the vehicles among whom it is
        self.frames = 0  # sent so far: the number that its draws go by, whatever others send
        self.free_ns = 0  # when its last frame was decided

    def meet(self, links: SenderLinks, names: tuple[str, ...]) -> None:
        """From now on it has these links, to all other vehicles."""
        self.links, self.names, self.row = links, names, names.index(links.sender)
        self.others = np.delete(np.arange(len(names)), self.row)
        self.draws = LinkDraws(links)

    def meant(self, to: str | None) -> slice:
        """Which of its receivers a message to ``to`` is meant for; None: all."""
        if to is None:
            return slice(None)
        if to not in self.links.receivers:
            raise ValueError(f"a message is addressed to {to!r}; possible: {', '.join(self.links.receivers) or 'none'}")
        place = self.links.receivers.index(to)
        return slice(place, place + 1)


class SentFrame(msgspec.Struct):
    """A message on its way."""

    frame: int  # its number in the channel
    sender: Transmitter
    number: int  # its number among those of its sender
    message: Message
    meant: slice  # for which receivers
    sent_ns: int  # handed to the radio
    air_ns: int
    mean: MeanBudget
    level_dbm: Floats  # (n,) at all receivers, of the last attempt to send it
    fading_db: Floats | None = None
    attempts: int = 1  # so far
    tries: list[tuple[Floats, Floats | None]] = msgspec.field(default_factory=list)  # level and fading of each, if they differ

    def frame_at(self, start_ns: int, end_ns: int, level_dbm: Floats) -> Frame:
        """The frame as layers are shown it, at levels (n,) dBm."""
        size = self.message.size_bytes
        return Frame(self.sent_ns, start_ns, end_ns, size, self.mean.paths, level_dbm, self.sender.links)

    def draw(self, slot: int) -> Draw:
        """The draws of one layer."""
        return lambda: self.sender.draws.uniform(self.number, slot)


class FrameBatch(msgspec.Struct):
    """Broadcasts of k vehicles at one instant, of which none has to do with another."""

    first: int  # the number of the first of them in the channel
    sent_ns: int
    senders: list[Transmitter]
    messages: list[Message]
    numbers: list[int]  # of these among those of their senders
    air_ns: list[int]
    end_ns: list[int]  # on the air
    every: BatchBudget
    heard: ReceivedSignal  # (k, n)

    def made(self, slot: int, make: Make) -> NDArray[Any]:
        """What ``make`` makes of the draws of one layer, (k, n)."""
        made = [sender.draws.made(number, slot, make) for sender, number in zip(self.senders, self.numbers, strict=True)]
        return np.stack(made)
