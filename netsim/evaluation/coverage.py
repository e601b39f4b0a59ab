"""Coverage: how strong one radio's signal is at many places, and how many of its frames would arrive there.

A receiver is thought to stand at each place. The mean level is the channel's own (path loss, walls, and the shadowing that
this seed has there); the chance of success is averaged over the fading. Nobody else sends: contention, jammers, scripts,
traces, and the losses and delays behind the radio have no part in it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.types import Vec3
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.mean_budget import MeanBudget
from vcmvsp.netsim.interfaces.layers import Floats, Frame, SenderLinks

_BLOCK = 2048  # places at a time: shadowing wants a few hundred numbers for each
_NODES, _TURN = 233, 144  # Fibonacci numbers: points of a lattice that fills the unit square evenly
_FARTHEST_M = 1e4  # nothing is looked for beyond


class Coverage(msgspec.Struct, frozen=True):
    """What n places hear of one transmitter."""

    level_dbm: Floats  # (n,) mean over the fading
    success: Floats  # (n,) chance that a frame arrives


def coverage(
    channel: Channel, sender: str, position: Floats, antennas: Floats, *, size_bytes: int = 100, seed: int = 0
) -> Coverage:
    """How the frames of one vehicle arrive at receivers that stand at many places, with no other vehicle in the way.

    Args:
        channel: as a run has it.
        sender: the vehicle, whose own radio counts.
        position: where it is, (3,) m, world; its antenna is above it.
        antennas: where those of the receivers are, (n, 3) m, world; they have no gain, and the phy's sensitivity.
        size_bytes: payload of a frame.
        seed: of the run.
    """
    level, success = np.empty(len(antennas)), np.empty(len(antennas))
    for first in range(0, len(antennas), _BLOCK):
        block = slice(first, first + _BLOCK)
        mean, links = _mean_at(channel, sender, position, antennas[block], seed)
        level[block] = mean.level_dbm
        success[block] = _success(channel, mean, links, size_bytes)
    return Coverage(level, success)


def among(channel: Channel, sender: str, places: Mapping[str, Vec3], *, size_bytes: int = 100, seed: int = 0) -> Coverage:
    """The same at the other vehicles, in the order of ``places`` (m, world): each with a radio of its own."""
    names = tuple(places)
    links = SenderLinks(seed, sender, tuple(name for name in names if name != sender))
    mean = _mean(channel, links, names, np.array(list(places.values()), np.float64), bodies=True)
    return Coverage(mean.level_dbm, _success(channel, mean, links, size_bytes))


def floor_dbm(channel: Channel) -> float:
    """The weakest level that is noticed where nobody else sends: the phy's sensitivity, or what the preamble needs."""
    return max(channel.budgets.least_dbm, channel.hearing.noise_dbm + channel.hearing.preamble_db)


def range_m(channel: Channel, sender: str, height_m: float) -> float | None:
    """How far the sender is noticed by path loss alone, within 1.2 %; None: farther than 10 km."""
    distance = np.geomspace(0.1, _FARTHEST_M, 1000)
    antennas = np.stack([distance, 0.0 * distance, 0.0 * distance + height_m], axis=-1)
    mean, _ = _mean_at(channel, sender, np.zeros(3), antennas, 0)
    heard = np.flatnonzero(mean.power_dbm - mean.path_loss_db >= floor_dbm(channel))
    if heard.size and heard[-1] == len(distance) - 1:
        return None
    return float(distance[heard[-1]]) if heard.size else 0.0


def _mean_at(channel: Channel, sender: str, position: Floats, antennas: Floats, seed: int) -> tuple[MeanBudget, SenderLinks]:
    """Mean budgets at any places: to the channel, receivers are vehicles that have no radio of their own."""
    links = SenderLinks(
        seed, sender, tuple(f"{sender} at {number}" for number in range(len(antennas)))
    )  # no vehicle is called so
    return _mean(channel, links, (sender, *links.receivers), np.concatenate([position[None], antennas]), bodies=False), links


def _mean(channel: Channel, links: SenderLinks, names: tuple[str, ...], position: Floats, *, bodies: bool) -> MeanBudget:
    channel.budgets.start()  # nothing is left of this question, or of one before
    mean = channel.budgets.mean(links, names, position, bodies=bodies)
    channel.budgets.start()
    return mean


def _success(channel: Channel, mean: MeanBudget, links: SenderLinks, size_bytes: int) -> Floats:
    """Chance that a frame is noticed and survives the noise, (n,), averaged over the fading."""
    air_ns = channel.phy.air_time_ns(size_bytes)
    gains = _gains(channel, Frame(0, 0, air_ns, size_bytes, mean.paths, mean.level_dbm, links))
    success = np.zeros(len(mean.level_dbm))
    for gain_db in gains:
        heard = channel.hearing.hear(mean, mean.level_dbm + gain_db, size_bytes)
        survives = 1.0 if heard.hazard is None else np.exp(-heard.hazard)
        success += np.where(heard.detected, survives, 0.0)
    return success / len(gains)


def _gains(channel: Channel, frame: Frame) -> list[Floats]:
    """Equally likely gains by fading, (n,) dB each: the layer's answers to draws that fill the unit square evenly.

    A fading that is a process in time has the same distribution as its independent draws.
    """
    fading: Any = channel.fading
    if fading is None:
        return [np.zeros(len(frame.rssi_dbm))]
    if getattr(fading, "doppler_hz", None) is not None:
        fading = dataclasses.replace(fading, doppler_hz=None)
    gains = []
    for number in range(_NODES):
        node = np.array([number + 0.5, number * _TURN % _NODES + 0.5]) / _NODES
        draws = np.tile(node, (len(frame.rssi_dbm), 1))
        gains.append(fading.gain_db(frame, lambda draws=draws: draws))
    return gains
