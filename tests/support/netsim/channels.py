"""Channels, paths and frames in one line each."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.types import FrameReport, Message, States
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import NoDelay
from vcmvsp.netsim.impairments.loss import NoLoss
from vcmvsp.netsim.interfaces.layers import Floats, Frame, Keys, Paths, SenderLinks
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.propagation.path_loss import LogDistance
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


def plain_channel(**layers: Any) -> Channel:
    """A channel of 802.11b without contention, losses and delays, with these layers in addition or instead."""
    plain: dict[str, Any] = {"path_loss": LogDistance(), "phy": Dsss(), "loss": NoLoss(), "delay": NoDelay()}
    return Channel(**plain | layers)


def play(
    channel: Channel, names: tuple[str, ...], position: Floats, sends: Iterable[Sequence[Any]], size_bytes: int = 100
) -> list[FrameReport]:
    """Reports of all frames, until the last is decided.

    Args:
        channel: at its start.
        names: of the vehicles.
        position: of the vehicles, (n, 3) m.
        sends: rising times (ns), senders and destinations (None: all) of the frames, and their sizes if they differ; the
            channel is only advanced at a time without a sender.
        size_bytes: of the others.
    """
    reports = []
    for time_ns, sender, to, *size in sends:
        reports += channel.advance(time_ns)
        if sender is not None:
            message = Message(sender=sender, body={}, size_bytes=size[0] if size else size_bytes, to=to)
            reports += channel.send(time_ns, message, names, position)
    return reports + channel.advance(10**13)


def send(channel: Channel, *distances: float, sent_ns: int = 0, size_bytes: int = 100, to: str | None = None) -> FrameReport:
    """One frame of car0, at the origin, to car1, car2, ... at these distances along the x axis."""
    names = ("car0", *(f"car{i + 1}" for i in range(len(distances))))
    position = np.array([(0.0, 0.0, 0.0), *((d, 0.0, 0.0) for d in distances)])
    message = Message(sender="car0", body={}, size_bytes=size_bytes, to=to)
    return only_report(channel.send(sent_ns, message, names, position))


def only_report(reports: list[FrameReport]) -> FrameReport:
    """The only report of a frame that was decided at once."""
    (report,) = reports
    return report


def at_rest(names: Sequence[str], position: Sequence[Sequence[float]] | Floats) -> States:
    """Vehicles at these places, level and at rest."""
    zero, attitude = np.zeros((len(names), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1))
    places = np.array(position, np.float64)
    return States(names=tuple(names), position=places, velocity=zero, attitude=attitude, angular_velocity=zero)


def make_frame(*shape: int) -> Frame:
    """A frame with a level array of the given shape, for calling a layer directly."""
    nowhere: NDArray[np.float64] = np.zeros((1, 3))
    return Frame(0, 0, 1_000_000, 100, Paths.between(nowhere[0], nowhere), np.zeros(shape), SenderLinks(1, "car0", ("car1",)))


class Line:
    """Pairs of points, one transmitter to a receiver."""

    @staticmethod
    def between(tx: Any, rx: Any, seed: int = 1) -> Paths:
        here, there = np.asarray(tx, np.float64), np.asarray(rx, np.float64)
        return Paths(here, there, np.sqrt(((there - here) ** 2).sum(axis=-1)), seed)


def along_x(*distances: float, tx_z: float = 0.0, rx_z: float = 0.0) -> Paths:
    """Paths from the z axis to these distances along the x axis."""
    return Paths.between(np.array([0.0, 0.0, tx_z]), np.array([(d, 0.0, rx_z) for d in distances]))


def linked_frame(sender: str, *receivers: str, at_s: float = 0.0, seed: int = 1, air_ns: int = 1_000_000) -> Frame:
    start = round(at_s * 1e9)
    return _frame(SenderLinks(seed, sender, receivers), start, start + air_ns)


def many_frame(count: int, at_ns: int = 0, seed: int = 1) -> Frame:
    """A frame with this many receivers, whose keys only have to differ."""
    links = SenderLinks(seed, "a", ("b",) * count)
    vars(links).update(keys=many_keys(count, seed), pair_keys=many_keys(count, seed))
    return _frame(links, at_ns, at_ns + 1)


def many_keys(count: int, seed: int = 1) -> Keys:
    return np.random.default_rng(seed).integers(0, 2**63, count).astype(np.uint64)


def even_uniforms(count: int) -> NDArray[np.float64]:
    """Uniforms (count, 2): the first evenly spaced, the second in an unrelated order."""
    first = (np.arange(count) + 0.5) / count
    return np.stack([first, np.random.default_rng(5).permutation(first)], axis=-1)


def _frame(links: SenderLinks, start_ns: int, end_ns: int) -> Frame:
    count = len(links.receivers)
    return Frame(start_ns, start_ns, end_ns, 100, Line.between(np.zeros(3), np.zeros((count, 3))), np.zeros(count), links)


def sinr_for(errors: ErrorRate, bits: int, success: float) -> float:
    grid = np.arange(-10.0, 40.0, 0.002)
    return float(np.interp(success, errors.success(grid, bits), grid))


def array(*values: float) -> Floats:
    return np.array(values)
