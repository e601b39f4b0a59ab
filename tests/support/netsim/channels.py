"""Channels, positions and frames in one line each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.interfaces.layers import Frame, Paths, SenderLinks
from vcmvsp.physics.world.solids import Box


def make_channel(
    name: str = "ideal",
    *,
    seed: int = 1,
    boxes: Sequence[Box] = (),
    vehicles: Sequence[str] = (),
    **changes: dict[str, Any],
) -> Channel:
    """A channel of a preset: ``make_channel("wifi-b-1", loss={"probability": 0.2})``, without contention unless asked."""
    tables = {"preset": name, "mac": {"kind": "ideal"}, **changes}
    channel: Channel = radio.build(tables, Source("test", Path()), solids=boxes, vehicles=vehicles)[0]
    channel.start(seed)
    return channel


def send(channel: Channel, *distances: float, sent_ns: int = 0, size_bytes: int = 100, to: str | None = None) -> FrameReport:
    """One frame of car0, which is at the origin, to car1, car2, ... at these distances along the x axis."""
    names = ("car0", *(f"car{i + 1}" for i in range(len(distances))))
    position = np.array([(0.0, 0.0, 0.0), *((d, 0.0, 0.0) for d in distances)])
    message = Message(sender="car0", body={}, size_bytes=size_bytes, to=to)
    return one(channel.send(sent_ns, message, names, position))


def one(reports: list[FrameReport]) -> FrameReport:
    """The only report of a frame whose fate was known at once."""
    (report,) = reports
    return report


def make_frame(*shape: int) -> Frame:
    """A frame with a level array of the given shape, for asking a layer directly."""
    nowhere: NDArray[np.float64] = np.zeros((1, 3))
    return Frame(0, 0, 1_000_000, 100, Paths.between(nowhere[0], nowhere), np.zeros(shape), SenderLinks(1, "car0", ("car1",)))
