"""Delays beyond the time on the air: relays, gateways, operating systems.

Delays count from the time of sending; no frame arrives before its end. Each frame and receiver has its own delay: frames with
random delays may overtake each other.
"""

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Probability, Seconds
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Frame, Ints
from vcmvsp.netsim.propagation.fading import gamma_quantile


@dataclass(frozen=True)
class Propagating:
    """A delay that may also count the wave's travel time: of the first path where rays are known, else of the straight line."""

    _: KW_ONLY
    propagation: bool = False  # a frame ends at a receiver by the travel time of its first path later


@dataclass(frozen=True)
class NoDelay(Propagating):
    """A frame is received when it ends."""

    nothing = True

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Zeros, (n,) ns: earlier than the end of any frame."""
        return np.zeros(frame.rssi_dbm.shape, np.int64)


@dataclass(frozen=True)
class FixedDelay(Propagating):
    """A frame is received ``seconds`` after its hand-over to the radio, plus or minus up to ``jitter_s``.

    The time on the air, and the wait for the sender's earlier frames, are part of ``seconds`` and not added to it; but no frame
    arrives before its last bit::

        received = max(end of the frame, sent + seconds + jitter)

    So agents at 10 Hz with ``seconds = 0.1`` hear each message exactly one period after it was sent. The jitter is uniform in
    [-jitter_s, +jitter_s], drawn for each frame and receiver; one that exceeds half the sending period lets frames overtake.
    """

    seconds: Seconds  # from sending to reception, time on the air included
    jitter_s: Seconds = 0.0  # uniform, give or take

    @property
    def nothing(self) -> bool:
        """Whether every frame is received when it ends."""
        return not (self._fixed_ns or self._jitter_ns)

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        if not self._jitter_ns:
            return np.full(frame.rssi_dbm.shape, self._fixed_ns, np.int64)
        return self.delay_ns_by(draw())

    def delay_ns_by(self, draws: Floats) -> Ints:
        """`delay_ns` from draws (..., n, 2) alone."""
        jitter = (2.0 * draws[..., 0] - 1.0) * self._jitter_ns
        return self._fixed_ns + np.rint(jitter).astype(np.int64)

    @cached_property
    def _fixed_ns(self) -> int:
        return seconds_to_ns(self.seconds)

    @cached_property
    def _jitter_ns(self) -> int:
        return seconds_to_ns(self.jitter_s)


@dataclass(frozen=True)
class UniformDelay(Propagating):
    """Anything between two bounds, equally likely."""

    from_s: Seconds  # shortest
    to_s: Seconds  # longest

    def __post_init__(self) -> None:
        if self.to_s < self.from_s:
            raise ScenarioError(f"must not be less than from_s = {self.from_s:g}, not {self.to_s:g}", key="to_s")

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        return _round_ns(self.from_s + (self.to_s - self.from_s) * draw()[..., 0])


@dataclass(frozen=True)
class NormalDelay(Propagating):
    """Normal distribution; a time below zero, or before the frame's end, becomes the frame's end."""

    mean_s: Seconds  # mean
    sigma_s: Seconds  # standard deviation

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        uniforms = draw()
        # Box-Muller transform: two uniforms give a normal number.
        normal = np.sqrt(-2.0 * np.log1p(-uniforms[..., 0])) * np.cos(2.0 * math.pi * uniforms[..., 1])
        return _round_ns(np.maximum(self.mean_s + self.sigma_s * normal, 0.0))


@dataclass(frozen=True)
class GammaDelay(Propagating):
    """A fixed part and a gamma distributed one: never early, sometimes very late, as behind queues.

    Mean and standard deviation are of the gamma distributed part. Its shape ``(mean_s / sigma_s)^2`` is from 0.1 to 1000; with
    shape 1 it is exponential.
    """

    mean_s: Seconds  # mean of the random part
    sigma_s: Seconds  # standard deviation of the random part
    fixed_s: Seconds = 0.0  # a part that is always there

    def __post_init__(self) -> None:
        if not 0.1 * self.sigma_s**2 <= self.mean_s**2 <= 1000.0 * self.sigma_s**2 or not self.sigma_s:
            problem = f"must be between 1/32 and 3 times mean_s = {self.mean_s:g}, and above 0, not {self.sigma_s:g}"
            raise ScenarioError(problem, key="sigma_s")

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        p = np.maximum(draw()[..., 0], 2.0**-54)
        quantile = gamma_quantile((self.mean_s / self.sigma_s) ** 2, np.log(p) - np.log1p(-p))
        return _round_ns(self.fixed_s + self.mean_s * quantile)


@dataclass(frozen=True)
class EmpiricalDelay(Propagating):
    """As measured: ``quantiles`` are pairs (probability, seconds) from 0 to 1, straight lines between them.

    ``quantiles = [[0, 0.002], [0.5, 0.004], [0.99, 0.03], [1, 0.2]]``: half of all frames take 2 to 4 ms.
    """

    quantiles: tuple[tuple[Probability, Seconds], ...]  # pairs [probability, s] that rise from 0 to 1, linear in between

    def __post_init__(self) -> None:
        probabilities = [pair[0] for pair in self.quantiles]
        seconds = [pair[1] for pair in self.quantiles]
        rising = all(a < b for a, b in pairwise(probabilities)) and seconds == sorted(seconds)
        if len(self.quantiles) < 2 or probabilities[0] != 0.0 or probabilities[-1] != 1.0 or not rising:
            problem = "must be pairs (probability, seconds) in increasing order, from probability 0 to probability 1"
            raise ScenarioError(problem, key="quantiles")

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        probabilities, seconds = np.array(self.quantiles).T
        return _round_ns(np.interp(draw()[..., 0], probabilities, seconds))


def _round_ns(seconds: Floats) -> Ints:
    return np.rint(seconds * SECOND_NS).astype(np.int64)
