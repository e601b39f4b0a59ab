"""Direct integration of the triangle under loss and delay: NumPy only, many followers at once, independent of the platform.

Kinematic vehicles at T = 0.1 s. A follower uses the newest report that has arrived: that of tick n is usable from tick
n + ``age`` on, unless it is lost. A table over (tick of the report, age in ticks) holds the estimates of each estimator, so a
tick of all followers is a look-up and the law (Toh 2012, 3-31 to 3-35, corrected).
"""

import functools
import math
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.reproduction.figures.scenarios import AHEAD, ASIDE, K1, K2, T, V
from vcmvsp.cosim.types import Array

ESTIMATORS = ("hold", "dr", "acc", "plan")
PATHS = ("slalom", "random")
LOST, HORIZON, FADE, PLAN, FROM = (
    30,
    20,
    10,
    20,
    200,
)  # ticks: lost; 2 s; 1 s; speeds of a plan besides the present ones; counts
AFTER = PLAN + 1 + HORIZON  # ticks: speeds at the end of a plan are used until then
SLOWEST = -0.1  # m/s
DECAY_S, LIMITS = 1.0, ((-0.1, 0.6), (-0.8, 0.8))  # of accelerations: decay time; limits of extrapolated speeds, m/s and rad/s


class LeaderTrack(NamedTuple):
    """Speeds (n, 2) of every tick, m/s and rad/s, and the resulting poses (n, 3), m and rad."""

    speeds: Array
    pose: Array


@functools.cache
def leader(path: str, duration_s: float = 120.0) -> LeaderTrack:
    """The standard paths of a leader, up to the end of its last plan."""
    count = round(duration_s / T) + PLAN + 1
    t = T * np.arange(count)
    slalom = np.stack([np.full(count, V), 0.4 * np.sin(math.tau * t / 16.0)], axis=-1)
    speeds = slalom if path == "slalom" else _random(count)
    pose = np.zeros((count, 3))
    for tick in range(count - 1):
        pose[tick + 1] = _arc(pose[tick], speeds[tick])
    return LeaderTrack(speeds, pose)


def rms(path: str, estimator: str, probability: Array, age: Array, *, count: int = 200) -> Array:
    """Root mean square of ``|z|`` (m) from 20 s to 120 s, for each pair of ``probability`` and ``age``, (n,).

    Args:
        path: path of the leader.
        estimator: estimator of the followers.
        probability: independent loss probability of each report, (n,).
        age: age at first use of a report that is not lost, ticks, (n,).
        count: followers of each pair; every other one is car3.
    """
    draws = np.random.Generator(np.random.PCG64(1))
    p, wait = (np.repeat(np.asarray(each), count) for each in (probability, age))
    missed = draws.random((round(120.0 / T) + 1, len(p))) < p
    each = errors(path, estimator, missed, wait)
    return np.asarray(np.sqrt((each.reshape(-1, count) ** 2).mean(axis=1)))


def errors(path: str, estimator: str, missed: Array, age: Array) -> Array:
    """Root mean square of ``|z|`` (m) from 20 s on of each of n followers; every other one is car3, on the leader's left.

    Args:
        path: path of the leader.
        estimator: estimator of the followers.
        missed: lost reports of each follower, (ticks, n).
        age: age of a report at first use, ticks, (n,).
    """
    ticks, number = missed.shape
    lead = leader(path, ticks * T)
    table = _predictions(lead, estimator, LOST)
    everyone, square = np.arange(number), np.zeros(number)
    side = np.where(everyone % 2, -ASIDE, ASIDE)
    pose = np.stack([np.full(number, -AHEAD), -side, np.zeros(number)], axis=-1)
    newest, last = np.full(number, -1), np.zeros((number, 2))
    for tick in range(ticks):
        sent_tick = tick - age
        arrived = (sent_tick >= 0) & ~missed[np.maximum(sent_tick, 0), everyone]
        newest = np.where(arrived, sent_tick, newest)
        if tick >= FROM:
            square += (_error(lead.pose[tick], pose, side) ** 2).sum(axis=-1)
        old = np.where(newest >= 0, tick - newest, 0)
        command = _law(table[newest, np.minimum(old, LOST)], pose, side)
        late = (old >= LOST)[:, np.newaxis]
        fading = np.clip(1.0 - (old - LOST) / FADE, 0.0, 1.0)[:, np.newaxis]
        last = np.where(late | (newest < 0)[:, np.newaxis], last, command)
        pose = _arc(pose, np.where(late, last * fading, last))
    return np.asarray(np.sqrt(square / (ticks - FROM)))


def _predictions(lead: LeaderTrack, estimator: str, oldest: int) -> Array:
    """Estimated pose and speeds of the leader, (reports, ages up to ``oldest``, 5)."""
    count = len(lead.pose) - PLAN
    table = np.empty((count, oldest + 1, 5))
    start, reported = lead.pose[:count], lead.speeds[:count]
    change = np.diff(reported, axis=0, prepend=reported[:1]) / T
    pose, believed = start, reported
    for age in range(oldest + 1):
        points = min(age, HORIZON)
        if estimator == "plan" and age <= PLAN:  # the plan contains the future speeds
            pose, believed = lead.pose[age : age + count], lead.speeds[age : age + count]
        elif estimator == "acc" and age <= HORIZON:
            low, high = np.array(LIMITS).T
            believed = np.clip(reported + DECAY_S * (1.0 - math.exp(-points * T / DECAY_S)) * change, low, high)
            pose = _arc(start, 0.5 * (reported + believed) * points)
        elif estimator != "hold" and age > 0:  # forward by a period, at the speeds in its middle
            pose = _arc(pose, believed * _remaining_share(estimator, age - 0.5))
        table[:, age] = np.concatenate([pose, believed * _remaining_share(estimator, age)], axis=-1)
    return table


def _remaining_share(estimator: str, age: float) -> float:
    """Remaining share of the speeds that an estimator uses after ``age`` ticks."""
    ends = {"hold": math.inf, "plan": AFTER}.get(estimator, HORIZON)
    return min(1.0, max(0.0, 1.0 - (age - ends) / FADE))


def _error(lead: Array, pose: Array, side: Array) -> Array:
    """Errors z (n, 2) in the followers' frames: from the handles, L ahead, to the points beside the leader; poses (..., 3)."""
    x, y, th = np.moveaxis(lead, -1, 0)
    off_x = x + side * np.sin(th) - pose[:, 0]
    off_y = y - side * np.cos(th) - pose[:, 1]
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack([off_x * cos + off_y * sin - AHEAD, off_y * cos - off_x * sin], axis=-1)


def _law(estimate: Array, pose: Array, side: Array) -> Array:
    """Commands (n, 2) for estimates (n, 5) of the leader, with the limit on reverse speed."""
    z = _error(estimate[:, :3], pose, side)
    v, w = estimate[:, 3], estimate[:, 4]
    turned = estimate[:, 2] - pose[:, 2]
    along = v + side * w
    forward = along * np.cos(turned) + K1 * z[:, 0]
    return np.stack([np.maximum(forward, SLOWEST), (along * np.sin(turned) + K2 * z[:, 1]) / AHEAD], axis=-1)


def _arc(pose: Array, speeds: Array) -> Array:
    """Poses (..., 3) after one period at constant speeds (..., 2)."""
    v, w = speeds[..., 0], speeds[..., 1]
    chord, heading = v * T * np.sinc(w * T / (2.0 * math.pi)), pose[..., 2] + 0.5 * w * T
    step = [chord * np.cos(heading), chord * np.sin(heading), w * T]
    return np.asarray(pose + np.stack(step, axis=-1))


def _random(count: int) -> Array:
    """Random speeds: new targets every 2 s, approached with at most 0.3 m/s2 and 0.6 rad/s2."""
    draws = np.random.Generator(np.random.PCG64(7))
    now, target, speeds = np.array([V, 0.0]), np.zeros(2), np.empty((count, 2))
    for tick in range(count):
        if tick % 20 == 0:
            target = np.array([draws.uniform(0.1, 0.45), draws.uniform(-0.35, 0.35)])
        now = now + np.clip(target - now, -np.array([0.03, 0.06]), np.array([0.03, 0.06]))
        speeds[tick] = now
    return speeds
