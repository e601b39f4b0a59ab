"""Coverage: mean level and success probability of one radio's frames at many positions.

The mean level is that of the channel (path loss, walls, and the shadowing of this seed); the success probability is averaged
over the fading. Contention, jammers, scripts, traces, losses and delays are left out.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.types import Vec3
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.link_budget import MeanBudget
from vcmvsp.netsim.interfaces.layers import Floats, Frame, SenderLinks

_BLOCK = 2048  # positions in a batch: shadowing needs a few hundred numbers for each
_NODES, _TURN = 233, 144  # Fibonacci numbers: points of a lattice that fills the unit square evenly
_FARTHEST_M = 1e4  # limit of the search for the range


class Coverage(msgspec.Struct, frozen=True):
    """Reception from one transmitter at n positions."""

    level_dbm: Floats  # (n,) mean over the fading
    success: Floats  # (n,) probability that a frame arrives


def coverage(
    channel: Channel, sender: str, position: Floats, antennas: Floats, *, size_bytes: int = 100, seed: int = 0
) -> Coverage:
    """Coverage of one vehicle without other vehicles in the way.

    Args:
        channel: of a run.
        sender: the vehicle, with its own radio.
        position: of the vehicle, (3,) m, world.
        antennas: of the receivers, (n, 3) m, world, without gain and with the phy's sensitivity.
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
    """Coverage of one vehicle at the other vehicles, with their own radios, in the order of ``places`` (m, world)."""
    names = tuple(places)
    links = SenderLinks(seed, sender, tuple(name for name in names if name != sender))
    mean = _mean(channel, links, names, np.array(list(places.values()), np.float64), bodies=True)
    return Coverage(mean.level_dbm, _success(channel, mean, links, size_bytes))


def floor_dbm(channel: Channel) -> float:
    """Detection threshold without interference: the phy's sensitivity or the preamble threshold."""
    return max(channel.budgets.least_dbm, channel.hearing.noise_dbm + channel.hearing.preamble_db)


def range_m(channel: Channel, sender: str, height_m: float) -> float | None:
    """Detection range by path loss alone, within 1.2 %; None: more than 10 km."""
    distance = np.geomspace(0.1, _FARTHEST_M, 1000)
    antennas = np.stack([distance, 0.0 * distance, 0.0 * distance + height_m], axis=-1)
    mean, _ = _mean_at(channel, sender, np.zeros(3), antennas, 0)
    detected = np.flatnonzero(mean.every.power_dbm[0] - mean.every.path_loss_db[0] >= floor_dbm(channel))
    if detected.size and detected[-1] == len(distance) - 1:
        return None
    return float(distance[detected[-1]]) if detected.size else 0.0


def _mean_at(channel: Channel, sender: str, position: Floats, antennas: Floats, seed: int) -> tuple[MeanBudget, SenderLinks]:
    """Mean budgets at any positions: the receivers are vehicles without their own radio."""
    places = tuple(f"{sender} at {number}" for number in range(len(antennas)))  # not valid as vehicle names
    links = SenderLinks(seed, sender, places)
    return _mean(channel, links, (sender, *links.receivers), np.concatenate([position[None], antennas]), bodies=False), links


def _mean(channel: Channel, links: SenderLinks, names: tuple[str, ...], position: Floats, *, bodies: bool) -> MeanBudget:
    channel.budgets.start()  # no cached budgets
    mean = channel.budgets.mean(links, names, position, bodies=bodies)
    channel.budgets.start()
    return mean


def _success(channel: Channel, mean: MeanBudget, links: SenderLinks, size_bytes: int) -> Floats:
    """Probability that a frame is detected and survives the noise, (n,), averaged over the fading."""
    air_ns = channel.phy.air_time_ns(size_bytes)
    gains = _gains(channel, Frame(0, 0, air_ns, size_bytes, mean.paths, mean.level_dbm, links))
    success = np.zeros(len(mean.level_dbm))
    for gain_db in gains:
        signal = channel.hearing.signal(mean.level_dbm + gain_db, mean.every.sensitivity_dbm[0], size_bytes)
        survives = 1.0 if signal.hazard is None else np.exp(-signal.hazard)
        success += np.where(signal.detected, survives, 0.0)
    return success / len(gains)


def _gains(channel: Channel, frame: Frame) -> list[Floats]:
    """Equally likely gains by fading, (n,) dB each: the layer's answers to draws that fill the unit square evenly.

    A fading that is a process in time has the same distribution as its independent draws.
    """
    fading: Any = channel.fading
    if fading is None:
        return [np.zeros(len(frame.rssi_dbm))]
    if getattr(fading, "by_place", False):
        return [fading.gain_db(frame, lambda: np.zeros((len(frame.rssi_dbm), 2)))]
    if getattr(fading, "doppler_hz", None) is not None:
        fading = dataclasses.replace(fading, doppler_hz=None)
    gains = []
    for number in range(_NODES):
        node = np.array([number + 0.5, number * _TURN % _NODES + 0.5]) / _NODES
        draws = np.tile(node, (len(frame.rssi_dbm), 1))
        gains.append(fading.gain_db(frame, lambda draws=draws: draws))
    return gains
