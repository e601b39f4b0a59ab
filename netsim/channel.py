"""The channel: the chain of layers through which a frame passes to all its receivers.

::

    queue of the sender -> air time (phy) -> path loss -> sensitivity (phy) -> loss -> delay -> received, or lost with a cause
"""

import numpy as np

from cosim.types import FrameReport, Message, frozen
from netsim.draws import DELAY_SLOT, LOSS_SLOT, LinkDraws
from netsim.layers import Delay, Floats, Frame, Loss, PathLoss, Paths, Phy

RECEIVED = "received"
BELOW_SENSITIVITY = "below sensitivity"


class Channel:
    """All links between all vehicles.

    A sender transmits one frame at a time: one that is handed over while the last is still on the air begins when that one
    ends. Frames of different senders do not disturb each other.
    """

    def __init__(self, *, path_loss: PathLoss, phy: Phy, loss: Loss, delay: Delay) -> None:
        self.path_loss, self.phy, self.loss, self.delay = path_loss, phy, loss, delay
        self.start(seed=0)

    def start(self, seed: int) -> None:
        """Forget all frames and draw from ``seed`` from now on."""
        self._seed = seed
        self._frames = 0
        self._senders: dict[str, _Sender] = {}

    def transmit(self, sent_ns: int, message: Message, names: tuple[str, ...], position: Floats) -> FrameReport:
        """Send one frame and say what becomes of it at every receiver it is meant for.

        Args:
            sent_ns: when it is handed to the radio; must not decrease from call to call.
            message: what is sent, by whom, to whom.
            names: the vehicles, in the order in which receivers are reported.
            position: where they are, (len(names), 3) m, world.
        """
        sender = self._senders.setdefault(message.sender, _Sender())
        if sender.links is None or (sender.links.names is not names and sender.links.names != names):
            sender.links = _Links(self._seed, message.sender, names)
        links, number = sender.links, sender.frames
        to = links.meant(message.to)

        air_ns = self.phy.air_time_ns(message.size_bytes)
        if air_ns < 1:
            raise ValueError(f"{type(self.phy).__name__}.air_time_ns({message.size_bytes}) is {air_ns}: must be at least 1 ns")
        start_ns = max(sent_ns, sender.free_ns)
        end_ns = start_ns + air_ns

        paths = Paths.between(position[links.tx], position[links.rx[to]])
        rssi_dbm = self.phy.tx_power_dbm - self.path_loss.loss_db(paths)
        frame = Frame(sent_ns, start_ns, end_ns, message.size_bytes, paths, rssi_dbm)

        audible = rssi_dbm >= self.phy.sensitivity_dbm
        received = audible & ~self.loss.lost(frame, lambda: links.draws.uniform(number, LOSS_SLOT)[to])
        earliest = sent_ns + self.delay.delay_ns(frame, lambda: links.draws.uniform(number, DELAY_SLOT)[to])

        report = FrameReport(
            frame=self._frames,
            sender=message.sender,
            sent_ns=sent_ns,
            size_bytes=message.size_bytes,
            receivers=links.receivers[to],
            distance_m=frozen(paths.distance_m),
            rssi_dbm=frozen(rssi_dbm),
            received_ns=frozen(np.where(received, np.maximum(earliest, end_ns), -1)),
            outcome=tuple(
                RECEIVED if arrived else self.loss.cause if heard else BELOW_SENSITIVITY
                for arrived, heard in zip(received.tolist(), audible.tolist(), strict=True)
            ),
        )
        sender.frames, sender.free_ns = number + 1, end_ns
        self._frames += 1
        return report


class _Sender:
    """What a transmitter remembers from frame to frame."""

    def __init__(self) -> None:
        self.frames = 0  # sent so far: the number that its draws go by, whatever others send
        self.free_ns = 0  # when its last frame ends
        self.links: _Links | None = None


class _Links:
    """The links from one sender to every other vehicle."""

    def __init__(self, seed: int, sender: str, names: tuple[str, ...]) -> None:
        if sender not in names:
            raise ValueError(f"{sender} sends, but its position is unknown; known: {', '.join(names) or 'none'}")
        self.names = names
        self.receivers = tuple(name for name in names if name != sender)
        self.tx = names.index(sender)  # its row
        self.rx = np.array([row for row, name in enumerate(names) if name != sender], np.intp)  # theirs
        self.draws = LinkDraws(seed, sender, self.receivers)

    def meant(self, to: str | None) -> slice:
        """Which receivers a message to ``to`` is meant for; None: all."""
        if to is None:
            return slice(None)
        if to not in self.receivers:
            raise ValueError(f"a message is addressed to {to!r}; possible: {', '.join(self.receivers) or 'none'}")
        row = self.receivers.index(to)
        return slice(row, row + 1)
