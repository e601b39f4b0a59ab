"""Losses of frames that are strong enough to be received: independent, or in bursts."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.cosim.types import Probability
from vcmvsp.netsim.interfaces.layers import BURST_SLOT, Bools, Draw, Floats, Frame, Keys


class NoLoss:
    """Nothing is lost."""

    nothing: ClassVar[bool] = True
    cause: ClassVar[str] = "none"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """False for every receiver, (n,)."""
        return np.zeros(frame.rssi_dbm.shape, np.bool_)


@dataclass(frozen=True)
class Bernoulli:
    """Every frame is lost with one probability on all links, independently of all others."""

    probability: Probability  # of a message to be lost, whatever its size
    cause: ClassVar[str] = "random loss"

    @property
    def nothing(self) -> bool:
        """Whether nothing is ever lost."""
        return self.probability == 0.0

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        return self.lost_by(draw())

    def lost_by(self, draws: Floats) -> Bools:
        """`lost` from draws (..., n, 2) alone."""
        return draws[..., 0] < self.probability


PerSecond = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]
Share = Annotated[float, msgspec.Meta(ge=0.001, le=0.999)]
Length = Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)]  # s

_MEAN = 16  # renewals in a cell of time, on average
_MOST = 64  # and at most: a Poisson number of mean 16 exceeds 64 once in 1e18


@dataclass(frozen=True)
class GilbertElliott:
    """A link is good or bad for a while, and loses frames with another probability in each state.

    E. N. Gilbert, Capacity of a burst-noise channel, 1960; E. O. Elliott, Estimates of error rates for codes on burst-noise
    channels, 1963. Rates are per second, p from good to bad and r back, so that results do not depend on how often
    frames are sent. The states last 1/p and 1/r s on average, exponentially distributed; the long-term share of losses is::

        p / (p + r) bad_loss + r / (p + r) good_loss

    and states tau s apart have the correlation ``exp(-(p + r) tau)``. netem's ``gemodel p r 1-h 1-k`` counts frames: its
    autocorrelation from frame to frame, 1 - p - r, is ``exp(-(p + r) T)`` here for a frame every T s.

    Each link (each direction) has a history of its own, a function of the seed, the link and time alone.
    """

    to_bad_per_s: PerSecond = 0.1  # p: how often a good link turns bad
    to_good_per_s: PerSecond = 1.0  # r: how often a bad link turns good; 1/r is the mean length of a burst
    bad_loss: Probability = 1.0  # 1 - h: of a frame to be lost while the link is bad
    good_loss: Probability = 0.0  # 1 - k: of a frame to be lost while the link is good
    cause: ClassVar[str] = "burst"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,), by the state of the link at the frame's start."""
        probability = np.where(self.bad(frame.keys, frame.start_ns), self.bad_loss, self.good_loss)
        return draw()[..., 0] < probability

    def bad(self, keys: Keys, time_ns: int) -> Bools:
        """Which of the links (n,) are in the bad state at one instant."""
        # A chain with two states is equivalent to one that draws a new state at the rate p + r, bad with probability
        # p / (p + r), independent of the old state. So no history from the start is needed, and the cost is constant in time.
        rate = self.to_bad_per_s + self.to_good_per_s
        cell_ns = max(1, round(_MEAN / rate * SECOND_NS))
        cell, inside_ns = divmod(time_ns, cell_ns)
        times, states = _cell(keys.tobytes(), cell, cell_ns, rate, self.to_bad_per_s / rate)
        passed = (times <= inside_ns).sum(axis=-1)
        return states[np.arange(len(passed)), passed]


@dataclass(frozen=True)
class Bursts:
    """Stretches of time in which all frames are lost, and others in which none is; how long they are does not change the share.

    A `GilbertElliott` of ``bad_loss`` 1 and ``good_loss`` 0 with, per second::

        r = 1 / mean_burst_s,    p = r probability / (1 - probability)

    Its bad and good times are exponentially distributed. For frames T s apart, the mean run of losses is
    ``1 / ((1 - probability) (1 - exp(-(p + r) T)))`` frames: for very short bursts as for independent losses.
    """

    probability: Share = 0.2  # share of the frames that are lost
    mean_burst_s: Length = 1.0  # mean length of a burst
    cause: ClassVar[str] = "burst"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        return self._states.lost(frame, draw)

    @cached_property
    def _states(self) -> GilbertElliott:
        to_good = 1.0 / self.mean_burst_s
        return GilbertElliott(to_good * self.probability / (1.0 - self.probability), to_good)


@lru_cache(maxsize=256)
def _cell(keys: bytes, cell: int, cell_ns: int, rate: float, chance: float) -> tuple[Floats, Bools]:
    """Renewals and states of n links in a cell of time.

    Returns:
        Times of renewals, ns from the cell's start, (n, _MOST), increasing; and the states before the first and after each of
        them, (n, _MOST + 1), True for bad.
    """
    times, states = _renewals(keys, cell, rate, chance)
    # The cell starts with the last state of the cell before; if that has no renewals (once in 1e7), with its first drawn state.
    before, earlier = _renewals(keys, cell - 1, rate, chance)
    last = np.maximum((before < cell_ns).sum(axis=-1) - 1, 0)
    first = earlier[np.arange(len(last)), last]
    return times, np.concatenate([first[:, None], states], axis=-1)


def _renewals(keys: bytes, cell: int, rate: float, chance: float) -> tuple[Floats, Bools]:
    """Instants of a Poisson process, ns from the cell's start, and the states that begin there, (n, _MOST) each."""
    # Cell -1, before the run, uses the last 64-bit numbers.
    numbers = np.uint64(cell * _MOST % 2**64) + np.arange(_MOST, dtype=np.uint64)
    uniforms = link_uniform(np.frombuffer(keys, np.uint64)[:, None], numbers, BURST_SLOT)
    gaps = -np.log1p(-uniforms[..., 0]) * (SECOND_NS / rate)
    return np.cumsum(gaps, axis=-1), uniforms[..., 1] < chance
