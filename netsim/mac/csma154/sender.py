"""One IEEE 802.15.4 sender: the rules of access, its state, and its random numbers."""

import math
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.interfaces.layers import Keys
from vcmvsp.netsim.interfaces.link_draws import BACKOFF_SLOT
from vcmvsp.netsim.interfaces.medium import Codes, Offered
from vcmvsp.netsim.mac.csma154.receivers import AirborneFrame

UNIT_NS = 320_000  # aUnitBackoffPeriod, 20 symbols
CCA_NS = 128_000  # 8 symbols

_BLOCK = 16  # contentions planned at once


class Csma154Rules(NamedTuple):
    """The parameters of `netsim.mac.csma154.parameters.Csma154` that senders go by."""

    min_be: int
    max_be: int
    max_backoffs: int
    acknowledge: bool
    max_retries: int
    queue_frames: int | None
    lifetime_ns: int | None


class RadioState(Enum):
    """What a radio is at."""

    NOTHING = auto()
    CONTENDING = auto()  # backoff and assessment
    SENDING = auto()  # turnaround included
    AWAITING = auto()  # an acknowledgement
    RESTING = auto()  # interframe space
    ANSWERING = auto()  # acknowledgement and both turnarounds


class Csma154Radio:
    """One sender: its queue, the frame it is at, and how far it has come with it."""

    def __init__(self, row: int, key: Keys, rules: Csma154Rules) -> None:
        self.row = row
        self.doing = RadioState.NOTHING
        self.stamp = 0  # events of earlier stamps are cancelled
        self.queue: list[tuple[int, int, Offered]] = []  # heap: higher priorities first, then first come, first served
        self.ready_ns = 0  # end of the interframe space
        self.frame: Offered | None = None
        self.air_ns = 0  # of the frame
        self.assessments_ns: list[int] = []  # ends of all that this contention may take
        self.found_busy = 0  # of these
        self.attempts = 0  # on the air
        self.flight: AirborneFrame | None = None  # on the air
        self.last: tuple[AirborneFrame, Codes] | None = None  # attempt, and its fate
        self.received_ns = -1  # of a unicast frame: when it was received; of any other, when it was sent
        self.answers: tuple[int, int] | None = None  # row and frame that it acknowledges now
        self._key = key  # (1,)
        self._windows = 2.0 ** np.minimum(rules.min_be + np.arange(rules.max_backoffs + 1), rules.max_be)
        self._contentions = 0
        self._plans: list[list[int]] = []
        self._luck: list[list[float]] = []

    def plan(self) -> list[int]:
        """Contend once more: when each assessment ends if those before it find the air busy, from now on, in ns.

        Draw k is a pure function of the radio's key and k. Contention c uses draws c m to c m + m - 1, m = max_backoffs + 1,
        whether it needs them all or not.
        """
        place = self._contentions % _BLOCK
        if place == 0:
            shape = _BLOCK, len(self._windows)
            first = self._contentions * len(self._windows)
            draws = link_uniform(self._key, np.arange(first, first + shape[0] * shape[1], dtype=np.uint64), BACKOFF_SLOT)
            units = (draws[:, 0].reshape(shape) * self._windows).astype(np.int64)
            self._plans = np.cumsum(units * UNIT_NS + CCA_NS, axis=1).tolist()
            self._luck = draws[:, 1].reshape(shape).tolist()
        self._contentions += 1
        return self._plans[place]

    def luck(self) -> float:
        """The patience (`netsim.interfaces.medium.Offered`) with the acknowledgement of the last attempt."""
        return -math.log1p(-self._luck[(self._contentions - 1) % _BLOCK][0])
