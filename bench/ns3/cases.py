"""Scenarios in which both simulators are compared."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bench.ns3.program import Floats

SIZE = 100  # bytes of payload, most often
REFERENCE_LOSS_DB = {"b": 40.052, "g": 40.052, "a": 46.684, "n": 40.052, "ax": 40.052}  # at 1 m
_UNLOADED_MS = {"b-1": 1.33, "b-11": 0.341, "g-6": 0.264, "g-54": 0.1, "a-6": 0.242, "a-54": 0.078}


@dataclass(frozen=True)
class Case:
    """n nodes at random in a square, each sending periodically with a random phase (or, saturated, all the time).

    Phases hold for a whole run: whether two nodes collide is drawn once a seed. Hence many short runs.
    """

    phy: str  # "b-1": the preset is wifi-b-1
    nodes: int
    hz: float
    side_m: float = 200.0
    exponent: float = 2.0  # in 200 m: all are in range
    nakagami: float = 0.0  # m; 0: no fading
    size: int = SIZE  # bytes of payload
    errors: str = "table"  # packet errors of OFDM: ns-3's default, or yans, nist
    unicast: bool = False  # to the next node instead of to all
    sink: bool = False  # nodes on a circle around node 0, their destination
    ideal: bool = False  # rate control by SNR
    rts_bytes: int | None = None  # threshold of RTS/CTS; None: none
    saturated: bool = False
    duration_s: float = 1.0  # frames within this time count
    warmup_s: float = 0.3
    drain_s: float = 0.3  # frames that still wait at the end count as lost: more than 0.5, the lifetime, where queues are long
    seeds: int = 20

    @property
    def name(self) -> str:
        """Short, and unique."""
        load = "saturated" if self.saturated else f"{self.hz:g}Hz"
        more = f"-{self.side_m:g}m-n{self.exponent:g}" if (self.side_m, self.exponent) != (200.0, 2.0) else ""
        fading = f"-m{self.nakagami:g}" if self.nakagami else ""
        errors = f"-{self.errors}" if self.errors != "table" else ""
        size = f"-{self.size}B" if self.size != SIZE else ""
        flags = {
            "unicast": self.unicast,
            "sink": self.sink,
            "ideal": self.ideal,
            f"rts{self.rts_bytes}": self.rts_bytes is not None,
        }
        words = "".join(f"-{word}" for word, holds in flags.items() if holds)
        return f"{self.phy}-N{self.nodes}-{load}{size}{more}{fading}{errors}{words}"

    @property
    def hidden(self) -> bool:
        """Some nodes are hidden from each other."""
        return (self.side_m, self.exponent) != (200.0, 2.0)

    @property
    def positions(self) -> Floats:
        """(n, 3) m, the same for every seed; written with three decimals."""
        if self.sink:
            turn = 2.0 * np.pi * np.arange(self.nodes) / (self.nodes - 1)
            circle = self.side_m / 2.0 * np.stack((np.cos(turn), np.sin(turn), 0.0 * turn), axis=1)
            circle[0] = 0.0
            return circle.round(3)
        places = np.random.default_rng(self.nodes).uniform(0.0, self.side_m, (self.nodes, 3)).round(3)
        places[:, 2] = 0.0
        return places

    @property
    def control_rate(self) -> str:
        """Rate of RTS, Mbit/s: that of acknowledgements."""
        standard, rate = self.phy.split("-")
        rates = ("1", "2", "5.5", "11") if standard == "b" else ("6", "12", "24")
        return max((each for each in rates if float(each) <= float(rate)), key=float)

    def ns3(self, seed: int) -> dict[str, str | float]:
        """The options of ``wifi.cc``."""
        standard, rate = self.phy.split("-")
        options: dict[str, str | float] = {
            "standard": standard,
            "rate": rate,
            "hz": self.hz,
            "size": self.size,
            "exponent": self.exponent,
            "reference-loss": REFERENCE_LOSS_DB[standard],
            "duration": self.duration_s,
            "warmup": self.warmup_s,
            "drain": self.drain_s,
            "seed": seed,
        }
        if self.errors != "table":
            options["error-model"] = self.errors
        if self.nakagami:
            options |= {"fading": "nakagami", "m": self.nakagami}
        if self.rts_bytes is not None:
            options |= {"ns3::WifiRemoteStationManager::RtsCtsThreshold": self.rts_bytes, "control": self.control_rate}
        flags = {"unicast": self.unicast, "sink": self.sink, "ideal": self.ideal, "saturated": self.saturated}
        return options | {name: 1 for name, holds in flags.items() if holds}


def square(phy: str, nodes: int, hz: float) -> Case:
    """One collision domain; enough runs for some 10 000 frames, or for a steady state under overload."""
    if nodes * hz * _UNLOADED_MS[phy] / 1000.0 > 0.9:
        return Case(phy, nodes, hz, duration_s=1.0, warmup_s=1.0, drain_s=0.6, seeds=40 if nodes <= 10 else 8)
    duration_s = max(2.0 / hz, min(5.0, 10_000 / (nodes * hz * 20)))
    return Case(phy, nodes, hz, duration_s=duration_s, seeds=60 if nodes <= 10 else 20)


PHYS = ("b-1", "b-11", "g-6", "g-54", "a-6", "a-54")
PLANE: dict[str, Any] = {"side_m": 600.0, "exponent": 3.0}
FULL: dict[str, Any] = {"saturated": True, "drain_s": 0.6}
LOST: dict[str, Any] = {"exponent": 3.0, "size": 500, "unicast": True, "drain_s": 0.8}


def squares() -> Iterator[Case]:
    """One collision domain, of all rates, densities and loads."""
    for phy, n, hz in product(PHYS, (3, 10, 50, 100), (10, 50, 100)):
        yield square(phy, n, hz)


def wide() -> Iterator[Case]:
    """Hidden nodes."""
    for phy, n in product(PHYS, (50, 100)):
        yield Case(phy, n, 10, **PLANE, duration_s=2.0, seeds=10)
    for phy in ("b-1", "g-6"):
        yield Case(phy, 50, 50, **PLANE, seeds=10)
    yield Case("b-1", 50, 10, **PLANE, nakagami=1.0, seeds=10)
    yield Case("g-6", 50, 10, **PLANE, nakagami=3.0, seeds=10)
    for errors in ("yans", "nist"):
        yield Case("g-54", 100, 10, **PLANE, errors=errors, duration_s=2.0, seeds=10)


def unicast() -> Iterator[Case]:
    """Acknowledged frames, and saturated broadcasts."""
    for phy, n in product(PHYS, (2, 5, 10, 20)):
        yield Case(phy, n, 0, unicast=True, **FULL, seeds=5)
    yield Case("g-54", 20, 0, unicast=True, **FULL, errors="yans", seeds=5)
    for phy in ("b-11", "g-6"):
        yield Case(phy, 10, 20, unicast=True, seeds=20)
    yield Case("g-24", 10, 50, side_m=100.0, nakagami=1.5, **LOST, seeds=10)
    yield Case("b-5.5", 20, 20, side_m=100.0, nakagami=1.0, **LOST, seeds=10)
    for phy, n in product(("b-1", "g-6"), (2, 5, 20)):
        yield Case(phy, n, 0, **FULL, duration_s=3.0, seeds=40 // n + 4)


def of_standard(standard: str, loads: Mapping[str, int], hidden: Sequence[str], saturated: Sequence[str]) -> Iterator[Case]:
    """One collision domain, hidden nodes and saturated frames with rates of 802.11n or 802.11ax.

    Args:
        standard: of the names of the rates.
        loads: frames a second of each node, Hz, by rate.
        hidden: rates with hidden nodes.
        saturated: rates of nodes that always have a frame.
    """
    for (rate, hz), n in product(loads.items(), (10, 50)):
        yield Case(f"{standard}-{rate}", n, hz)
    for rate in hidden:
        yield Case(f"{standard}-{rate}", 50, 10, **PLANE, duration_s=2.0, seeds=10)
    for rate, n in product(saturated, (2, 10)):
        yield Case(f"{standard}-{rate}", n, 0, unicast=True, **FULL, seeds=5)


def rts() -> Iterator[Case]:
    """Frames behind RTS and CTS."""
    for phy, n in product(("b-11", "g-54", "n-65"), (2, 10)):
        yield Case(phy, n, 0, unicast=True, size=1000, rts_bytes=500, **FULL, seeds=5)
    for (phy, size), least in product((("b-1", 1000), ("g-6", 2000), ("n-26", 1000)), (None, 500)):
        yield Case(phy, 3, 0, 140.0, 3.0, size=size, sink=True, rts_bytes=least, saturated=True, duration_s=5.0, seeds=10)
    for phy, n, hz in (("g-24", 20, 20), ("n-26", 20, 20), ("b-11", 10, 50)):
        yield Case(phy, n, hz, side_m=150.0, rts_bytes=400, **LOST, seeds=60)


def ideal() -> Iterator[Case]:
    """Rates chosen by the signal-to-noise ratio."""
    for phy, sides_m in (("a-6", (20, 40, 60, 80)), ("n-6.5", (20, 60, 100, 140)), ("ax-8.6", (10, 20, 60, 100, 140))):
        for side_m in sides_m:
            yield Case(phy, 2, 0, side_m=side_m, exponent=3.0, size=1000, sink=True, ideal=True, saturated=True, seeds=5)
    for (phy, side), m in product((("a-6", 40.0), ("n-6.5", 60.0), ("ax-8.6", 60.0)), (0.0, 3.0)):
        yield Case(phy, 10, 20, side_m=side, nakagami=m, **{**LOST, "size": 1000}, ideal=True, seeds=20)


CASES = (
    *squares(),
    *wide(),
    *unicast(),
    *of_standard("n", {"6.5": 50, "65": 100}, ("13", "39", "65"), ("6.5", "26", "65")),
    Case("n-65", 10, 20, unicast=True, size=1000, seeds=20),
    *rts(),
    *of_standard("ax", {"8.6": 50, "143.4": 100}, ("17.2", "86", "114.7"), ("8.6", "34.4", "143.4")),
    *ideal(),
)
