"""Runs of IEEE 802.15.4 radios, for tests."""

from collections import Counter
from typing import Any

import numpy as np

from vcmvsp.cosim.rng import key64, link_uniform
from vcmvsp.netsim.interfaces.layers import BACKOFF_SLOT, Floats
from vcmvsp.netsim.interfaces.medium import Decided, Medium, Offered
from vcmvsp.netsim.mac.csma154.medium import Csma154
from vcmvsp.netsim.phy.ieee802154 import Ieee802154

US, MS = 1_000, 1_000_000  # ns
PHY = Ieee802154()
NOISE_DBM = PHY.noise_dbm
LOUD, SILENT = -40.0, -300.0  # dBm: received for sure, not detected


def keys(count: int, seed: int = 1) -> Any:
    return np.array([key64(seed, str(row)) for row in range(count)], np.uint64)


def backoffs(count: int, row: int) -> list[float]:
    """Uniforms behind the first backoff of each contention of a radio, by the definition: each contention has five."""
    return draws(5 * count, row)[::5]


def draws(count: int, row: int, seed: int = 1) -> list[float]:
    return link_uniform(keys(row + 1, seed)[row:], np.arange(count, dtype=np.uint64), BACKOFF_SLOT)[:, 0].tolist()


def levels(count: int, dbm: float = LOUD) -> Floats:
    """Equal levels on all links."""
    return np.full((count, count), dbm)


class World:
    """A medium, and levels (n, n) dBm from radio to radio."""

    def __init__(self, dbm: Floats, seed: int = 1, **mac: Any) -> None:
        self.power_mw = 10.0 ** (dbm / 10.0)
        self.count = len(dbm)
        self.medium: Medium = Csma154(**mac).open(PHY, self.count, keys(self.count, seed), 10.0 ** (NOISE_DBM / 10.0))
        self.offered = 0
        self.sent: Counter[int] = Counter()  # attempts, by frame

    def offer(
        self, time_ns: int, sender: int, *, to: int = -1, size: int = 50, priority: int = 0, patience: float | None = None
    ) -> int:
        number, self.offered = self.offered, self.offered + 1
        luck = self.patience(number) if patience is None else np.full((40, self.count), patience)
        power_mw = self.power_mw[sender]

        def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
            self.sent[number] += 1
            return power_mw, luck[attempt]

        self.medium.offer(Offered(number, time_ns, sender, to, size, priority, None, None, renew))
        return number

    def patience(self, number: int) -> Floats:
        """By attempt and radio."""
        return np.random.default_rng((number, 7)).standard_exponential((40, self.count))

    def finish(self) -> dict[int, Decided]:
        decided = self.medium.advance(10**12)
        assert [each.end_ns for each in decided] == sorted(each.end_ns for each in decided)
        return {each.number: each for each in decided}


def assessments(row: int, busy: int, from_ns: int = 0) -> list[int]:
    """Ends of a radio's first channel assessments; all but the last find the air busy."""
    ends = []
    for exponent, uniform in zip((3, 4, 5, 5, 5), draws(busy + 1, row), strict=False):
        from_ns += int(uniform * 2**exponent) * 320 * US + 128 * US
        ends.append(from_ns)
    return ends


def line(left_dbm: float, right_dbm: float) -> Floats:
    """0 and 2 are hidden from each other, 1 is in range of both."""
    dbm = np.full((3, 3), SILENT)
    dbm[0, 1] = dbm[1, 0] = left_dbm
    dbm[2, 1] = dbm[1, 2] = right_dbm
    return dbm


def at(start_ns: int, row: int) -> int:
    """Time at which to offer a radio's first frame, for it to begin at a given time if the air is free."""
    return start_ns - assessments(row, 0)[0] - 192 * US
