"""Fading: fast variations of the level by multipath propagation.

Each model is a distribution of the power gain g with mean 1, drawn for each link and frame. Without ``doppler_hz`` the
draws are independent; with it, they are samples of a process in time. Set it if messages come faster than the channel changes:
at v m/s and f Hz the greatest Doppler shift is ``fd = v f / c``, 8 Hz at 1 m/s and 2.4 GHz, and the coherence time is about
0.4 / fd, 50 ms.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.cosim.types import NonNegative
from vcmvsp.netsim.interfaces.layers import WAVE_SLOT, Draw, Floats, Frame, Keys

Complex = NDArray[np.complex128]
Doppler = Annotated[float, msgspec.Meta(gt=0, le=1e6)]  # Hz
Shape = Annotated[float, msgspec.Meta(ge=0.1, le=1000)]

_FAINTEST = 2.0**-54  # stands for a uniform of 0, so that every gain is finite in dB
_WAVES = 128  # of a process: it has the normalised variance 1 - 1 / _WAVES instead of 1


@dataclass(frozen=True)
class Rayleigh:
    """No direct path: g is exponential, the squared magnitude of a complex normal number."""

    doppler_hz: Doppler | None = None  # greatest shift, v f / c; None: frames fade independently

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Power gain at each receiver, (n,) dB."""
        return _db(_exponential(frame, draw, self.doppler_hz))


@dataclass(frozen=True)
class Nakagami:
    """g is gamma distributed with shape m and mean 1: ``m = 1`` is Rayleigh, less is worse, more comes nearer to no fading.

    M. Nakagami, The m-distribution, 1960. ns-3: ``NakagamiPropagationLossModel`` with ``m0 = m1 = m2 = m``; its defaults are
    1.5 up to 80 m and 0.75 beyond. In time it is the Rayleigh process carried over from quantile to quantile.
    """

    m: Shape = 1.5  # shape: 1 is Rayleigh; smaller: more fading, larger: less fading
    doppler_hz: Doppler | None = None  # greatest shift, v f / c; None: frames fade independently

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Power gain at each receiver, (n,) dB."""
        exponential = np.maximum(_exponential(frame, draw, self.doppler_hz), _FAINTEST)
        logit = exponential + np.log(-np.expm1(-exponential))  # of p = 1 - exp(-g), where log(p / (1 - p)) = log(exp(g) - 1)
        return _db(gamma_quantile(self.m, logit))


@dataclass(frozen=True)
class Rician:
    """A direct path K times as strong as all others together: ``g = |sqrt K + h|^2 / (K + 1)``, h complex normal, E|h|^2 = 1.

    ``k_factor`` is a ratio, not dB (10 is 10 dB). In time the direct path stands still and h has the Doppler spread.
    """

    k_factor: NonNegative = 4.0  # power of the direct path divided by that of all other paths
    doppler_hz: Doppler | None = None  # greatest shift, v f / c; None: frames fade independently

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Power gain at each receiver, (n,) dB."""
        if self.doppler_hz is None:
            uniforms = draw()
            scattered = np.sqrt(-np.log1p(-uniforms[..., 0])) * np.exp(2j * math.pi * uniforms[..., 1])  # Box and Muller
        else:
            scattered = scattering(frame.pair_keys, frame.start_ns, self.doppler_hz)
        return _db(np.abs(math.sqrt(self.k_factor) + scattered) ** 2 / (self.k_factor + 1.0))


def scattering(pair_keys: Keys, time_ns: int, doppler_hz: float) -> Complex:
    """Complex amplitude of the scattered paths of pairs (n,) at one instant, (n,).

    It depends on pair and time alone. It is the sum of waves from evenly spread directions alpha with random phases
    (R. H. Clarke, A statistical theory of mobile-radio reception, Bell System Technical Journal 47, 1968)::

        h(t) = sqrt(1 / M) sum_m exp(j (2 pi fd t cos(alpha_m) + phi_m))

    with ``E|h|^2 = 1``, the autocorrelation ``J0(2 pi fd tau)`` and, of the power, the autocovariance ``J0^2``.
    """
    cosines, phases = _waves(pair_keys.tobytes())
    turns = doppler_hz * (time_ns / SECOND_NS) * cosines + phases
    # Single precision is enough for a fraction of a turn, and several times as fast.
    angle = (turns - np.rint(turns)).astype(np.float32) * np.float32(2.0 * math.pi)
    real, imaginary = (wave.sum(axis=-1, dtype=np.float64) for wave in (np.cos(angle), np.sin(angle)))
    return (real + 1j * imaginary) / math.sqrt(_WAVES)


@lru_cache(maxsize=256)
def _waves(pair_keys: bytes) -> tuple[Floats, Floats]:
    """Cosines of the directions, and phases in turns, of all waves of all pairs, (n, _WAVES) each."""
    keys = np.frombuffer(pair_keys, np.uint64)
    uniforms = link_uniform(keys[:, None], np.arange(_WAVES, dtype=np.uint64), WAVE_SLOT)
    # One direction in each equal part of a half circle: the other half has the same shifts.
    directions = math.pi * (np.arange(_WAVES) + uniforms[..., 0]) / _WAVES
    return np.cos(directions), uniforms[..., 1]


def _exponential(frame: Frame, draw: Draw, doppler_hz: float | None) -> Floats:
    """Exponential gains with mean 1, (n,)."""
    if doppler_hz is None:
        return -np.log1p(-draw()[..., 0])
    return np.abs(scattering(frame.pair_keys, frame.start_ns, doppler_hz)) ** 2


def _db(gain: Floats) -> Floats:
    return 10.0 * np.log10(np.maximum(gain, _FAINTEST))


_NODES = 8192
_TAIL = -math.log(1e-18)  # the table ends where either tail holds less than this: uniforms end at 2**-53


def gamma_quantile(shape: float, logit: Floats) -> Floats:
    """Quantiles of the gamma distribution with mean 1 and variance 1 / shape, of any array of probabilities.

    The probabilities p are given as ``log(p / (1 - p))``, which is exact in both tails. For shapes from 0.1 to 1000 the
    relative error is below 4e-4 (0.002 dB) down to tails of 1e-16, and below 2e-5 between 5 and 95 % for shapes from 0.5.
    """
    nodes, logarithms = _table(shape)
    return np.exp(np.interp(logit, nodes, logarithms))


@lru_cache(maxsize=32)
def _table(shape: float) -> tuple[Floats, Floats]:
    """Logits of the probabilities, increasing, and logarithms of their quantiles.

    The density of t = log(x), ``exp(shape (t - e^t)) shape^shape / Gamma(shape)``, is integrated by Gauss's rule with three
    points in each interval: from below for the probability, from above for its complement.
    """
    # Below: P(t) <= (shape e^t)^shape / Gamma(shape + 1). Above (Chernoff): 1 - P(t) <= exp(shape (1 + t - e^t)).
    lowest = (math.lgamma(shape + 1.0) - _TAIL) / shape - math.log(shape)
    bound = 2.0 * _TAIL / shape
    highest = min(math.sqrt(bound), math.log(2.0 + bound))
    t = np.linspace(lowest, highest, _NODES)
    step = t[1] - t[0]
    middle, offset = 0.5 * (t[1:] + t[:-1]), 0.5 * math.sqrt(0.6) * step
    areas = step / 18.0 * (5.0 * _density(shape, middle - offset) + 8.0 * _density(shape, middle))
    areas += step / 18.0 * 5.0 * _density(shape, middle + offset)
    # Below the table the density is exponential: P = density / shape.
    below = np.cumsum(np.concatenate([_density(shape, t[:1]) / shape, areas]))
    above = np.cumsum(np.concatenate([[math.exp(-_TAIL)], areas[::-1]]))[::-1]
    inside = (below > 0.0) & (above > 0.0)
    return np.log(below[inside]) - np.log(above[inside]), t[inside]


def _density(shape: float, t: Floats) -> Floats:
    return np.exp(shape * (t - np.exp(t) + math.log(shape)) - math.lgamma(shape))
