"""Characteristics of step responses and their theory, independent of the product's own measures."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def overshoot(z: ArrayLike) -> float:
    """Overshoot of an error (n,), as a share of its start."""
    error = np.asarray(z, float)
    return max(0.0, float((-error / error[0]).max()))


def settling_s(z: ArrayLike, period_s: float, within: float) -> float:
    """Time from which an error (n,), taken every ``period_s`` from 0 s on, stays within the band: 0 s if it never leaves it."""
    outside = np.flatnonzero(np.abs(np.asarray(z, float)) > within)
    return period_s * (int(outside[-1]) + 1) if outside.size else 0.0


def servo_step(k1: float, period_s: float, tau_s: float, ticks: int) -> Floats:
    """z1 (ticks,) of ``v = v_leader + k1 z1``, sampled, through a first-order servo, from 1 and at the leader's speed.

    State (z1, v - v_leader), multiplied every period T by [[1 - k1 (T - tau (1 - a)), -tau (1 - a)], [(1 - a) k1, a]] with a =
    exp(-T / tau): the exact solution over a period of a constant command.
    """
    a = math.exp(-period_s / tau_s)
    way = tau_s * (1.0 - a)
    matrix = np.array([[1.0 - k1 * (period_s - way), -way], [(1.0 - a) * k1, a]])
    states = [np.array([1.0, 0.0])]
    while len(states) < ticks:
        states.append(matrix @ states[-1])
    return np.array(states)[:, 0]


def growth(y: Floats, step: int) -> float:
    """Growth per tick of an oscillation with one pair of roots z: y[n + 2 s] = a y[n + s] + b y[n] has |z|^(2 s) = -b."""
    past = np.stack([y[step:-step], y[: -2 * step]], axis=1)
    _, b = np.linalg.lstsq(past, y[2 * step :], rcond=None)[0]
    return float(math.sqrt(-b) ** (1.0 / step))


def root(gain: float, age: int) -> float:
    """Growth per tick of y[n + 1] = y[n] - gain y[n - age]: the largest abs(z) with z^(age + 1) - z^age + gain = 0.

    By Newton's method from the root in continuous time at the bound: computing all roots of a high degree is slow.
    """
    z = complex(np.exp(1j * min(gain, 0.5)))
    for _ in range(100):
        z -= (z - 1.0 + gain * z**-age) / (1.0 - age * gain * z ** (-age - 1))
    return abs(z)
