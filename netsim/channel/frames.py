"""Transmitters, frames, and batches of frames."""

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Message
from vcmvsp.netsim.channel.mean_budget import MeanBudget
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Frame, SenderLinks
from vcmvsp.netsim.interfaces.link_draws import LinkDraws
from vcmvsp.netsim.interfaces.medium import Codes


class Transmitter:
    """State of a transmitter between frames."""

    links: SenderLinks
    draws: LinkDraws
    row: int  # among the vehicles
    others: NDArray[np.intp]  # rows of the others

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()  # all vehicles
        self.frames = 0  # sent so far: its draws depend on this number, not on frames of others
        self.free_ns = 0  # time at which its last frame was decided

    def meet(self, links: SenderLinks, names: tuple[str, ...]) -> None:
        """Set the links to all other vehicles."""
        self.links, self.names, self.row = links, names, names.index(links.sender)
        self.others = np.delete(np.arange(len(names)), self.row)
        self.draws = LinkDraws(links)

    def destination(self, to: str | None) -> slice:
        """Places of the receivers of a message to ``to`` (None: all)."""
        if to is None:
            return slice(None)
        if to not in self.links.receivers:
            raise ValueError(f"a message is addressed to {to!r}; possible: {', '.join(self.links.receivers) or 'none'}")
        place = self.links.receivers.index(to)
        return slice(place, place + 1)


class SentFrame(msgspec.Struct):
    """A frame on its way."""

    frame: int  # number in the channel
    sender: Transmitter
    number: int  # of the sender's frames
    message: Message
    destination: slice  # places of the receivers
    sent_ns: int  # handed to the radio
    air_ns: int
    mean: MeanBudget
    level_dbm: Floats  # (n,) at all receivers, of the last attempt
    fading_db: Floats | None = None
    attempts: int = 1  # so far
    tries: list[tuple[Floats, Floats | None]] = msgspec.field(
        default_factory=list
    )  # level and fading of each attempt, if they differ

    def frame_at(self, start_ns: int, end_ns: int, level_dbm: Floats) -> Frame:
        """The frame as an argument of layers, with levels (n,) dBm."""
        size = self.message.size_bytes
        return Frame(self.sent_ns, start_ns, end_ns, size, self.mean.paths, level_dbm, self.sender.links)

    def draw(self, slot: int) -> Draw:
        """Draws of one layer."""
        return lambda: self.sender.draws.uniform(self.number, slot)


class FrameBatch(msgspec.Struct):
    """k frames after the medium, each at the n radios other than its sender."""

    frames: Sequence[SentFrame]  # (k,)
    fate: Codes  # (k, n) `Fate`
    start_ns: Sequence[int]  # (k,) of the last attempt; -1: never sent
    end_ns: Sequence[int]  # (k,) of that attempt, or the time at which the frame was given up
    snr_db: Floats  # (k, n)
    sinr_db: Floats  # (k, n) minimum over the frame
    interference_mw: Floats | None = None  # (k, n) of jammers
