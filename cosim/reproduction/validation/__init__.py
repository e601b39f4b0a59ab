"""Every law, closed form and outside reference of the platform, measured again: ``vcmvsp validate``.

A check is a function of a module here that measures and gives rows (`cosim.reproduction.row.Row`). Expected numbers are
computed where there is a formula, and stored with their source where they come from another program, a standard or a book.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.row import Row
from vcmvsp.cosim.reproduction.runner import Runner

TOH, OWN, NS3 = "Toh 2012", "independent simulation", "ns-3.44"
TIME, LINK, AIR = "Time and determinism", "Radio: one link", "Radio: shared air"
FORMATION, BODIES, AVOIDANCE, SEARCH = "Formation control", "Vehicles and sensors", "Avoidance", "Reconnaissance"
FEW_LOSSES: Mapping[str, Any] = {"probabilities": (0.0, 0.3, 0.7, 0.9), "followers": 12}


@dataclass(frozen=True)
class Check:
    """A measurement and the source of its expected numbers."""

    name: str
    area: str
    title: str
    source: str  # of what is expected
    measure: str  # "module:function" of this package, which yields each `Row`; or the name of a figure
    seconds: float = 2.0  # about, on one core: the longest begin first
    settings: Mapping[str, Any] = field(default_factory=dict)  # what the function is given
    reduced: str = ""  # in which way it is less than it could be


@dataclass(frozen=True)
class Outcome:
    """Rows of a check; without rows, its problem."""

    check: Check
    rows: Sequence[Row] = ()
    problem: str = ""

    @property
    def missed(self) -> Sequence[Row]:
        """Rows outside their tolerance."""
        return [row for row in self.rows if not row.ok]

    @property
    def ok(self) -> bool:
        """Whether there are rows, and all hold."""
        return bool(self.rows) and not self.missed


def run_all(checks: Sequence[Check], jobs: int, progress: Callable[[int, int], None]) -> list[Outcome]:
    """Run checks, longest first; the outcomes are in the order of ``checks``.

    Args:
        checks: to run.
        jobs: number of processes; 1: this one.
        progress: called after every check with the finished and the total number.
    """
    order = sorted(range(len(checks)), key=lambda place: -checks[place].seconds)
    results = Runner(jobs, progress)([partial(measured, checks[place]) for place in order])
    outcomes = dict(zip(order, results, strict=True))
    return [outcomes[place] for place in range(len(checks))]


def measured(check: Check) -> Outcome:
    """Run one check. An exception becomes its problem."""
    module, _, function = check.measure.partition(":")
    try:
        if function:
            rows: Sequence[Row] = list(getattr(importlib.import_module(f"{__name__}.{module}"), function)(**check.settings))
        else:
            rows = figures.find(module)(Runner(), **check.settings).rows
    except Exception as error:
        return Outcome(check, problem=f"{type(error).__name__}: {error}")
    return Outcome(check, rows, "" if rows else "gave no rows")


def _figure(area: str, name: str, source: str, seconds: float, reduced: str = "", **settings: object) -> Check:
    return Check(f"figure-{name}", area, figures.NAMES[name][1], source, name, seconds, settings, reduced)


def _ns3(name: str, case: str, seconds: float) -> Check:
    return Check(name, AIR, f"{case}: delivery, delays.", NS3, "medium_access:judged", seconds, {"name": case})


_ALL = (
    Check("ticks", TIME, "Trains of ticks; agents of several rates.", "k / rate", "timing:ticks"),
    Check("draws", TIME, "The generator behind all draws of links.", "Random123, known answers", "timing:draws"),
    Check("same-bytes", TIME, "A digest, wherever agents run.", "one scenario, one digest", "timing:same_bytes", 5),
    Check("late-loop", TIME, "A loop that is closed late, and when it is stable.", "z' = -k z(t - d)", "timing:late_loop", 4),
    Check("old-reports", TIME, "What a leader's reports cost by their age.", "v a; 2 R sin(w a / 2)", "timing:old_reports"),
    Check("path-loss", LINK, "Laws of distance, ranges.", "Friis; Rappaport 4.52; Toh 2012, 6.2.3", "radio:path_loss"),
    Check("walls", LINK, "Slabs of usual walls.", "ITU-R P.2040-3, averaged over the phase", "radio:walls"),
    Check("shadowing", LINK, "Spread, correlation, there and back.", "Gudmundson 1991", "radio:shadowing"),
    Check("fading", LINK, "Quantiles, mean, variance.", f"{NS3} (Nakagami); chi-squared; exponential", "radio:fading", 8),
    Check("doppler", LINK, "Fading in time: correlation of the power.", "Clarke 1968, J0 squared", "radio:doppler", 4),
    Check("success", LINK, "Success by SINR of every modulation.", NS3, "radio:success"),
    Check("received", LINK, "Frames received over one link.", f"{NS3}, 20,000 frames each", "radio:received"),
    Check("air-time", LINK, "Time on the air.", NS3, "radio:air_time"),
    Check("chance", LINK, "Losses on their own and in bursts.", "Bernoulli; Gilbert and Elliott", "radio:chance", 4),
    Check("queue", LINK, "Waiting behind one's own frames.", "Lindley; Pollaczek and Khinchine", "radio:queue", 12),
    Check("age", LINK, "Age of information by loss and delay.", "Kaul, Yates and Gruteser 2012", "radio:age"),
    Check("bianchi", AIR, "Saturated radios.", "Bianchi 2000", "medium_access:bianchi", 8),
    Check("periodic", AIR, "10 to 100 radios that broadcast at 10 Hz.", NS3, "medium_access:periodic", 25),
    _ns3("dcf-b-50", "802.11b, 50 in one domain", 3),
    _ns3("dcf-b-100", "802.11b, 100 in one domain, overloaded", 5),
    _ns3("dcf-b-hidden", "802.11b, 30, hidden from each other", 4),
    _ns3("dcf-g-100", "802.11g, 100 in one domain", 8),
    _ns3("dcf-g-hidden", "802.11g, 40, hidden from each other", 6),
    Check("lrwpan", AIR, "CSMA/CA of 802.15.4.", NS3, "medium_access:lrwpan", 4),
    _figure(FORMATION, "24", f"{TOH}, Fig. 24", 8),
    _figure(FORMATION, "25", f"{TOH}, Fig. 25", 2),
    _figure(FORMATION, "26", f"{TOH}, Fig. 26; {OWN}", 5),
    _figure(FORMATION, "30", f"{TOH}, Fig. 30; sampled servo", 6),
    _figure(FORMATION, "31", f"{TOH}, Fig. 31; {OWN}", 3),
    _figure(FORMATION, "32", f"{TOH}, Fig. 32; integration", 2),
    _figure(FORMATION, "33", f"{TOH}, Fig. 33; linear map", 5),
    _figure(FORMATION, "loss", f"integration; closed form; {OWN}", 75, "4 of 7 probabilities, fewer followers", **FEW_LOSSES),
    _figure(FORMATION, "delay", f"closed forms; {OWN}", 12),
    _figure(FORMATION, "loss-delay", f"integration; {OWN}", 55, "6 of 20 followers", followers=6),
    _figure(FORMATION, "estimators", OWN, 20),
    _figure(FORMATION, "chain", f"|G| of a hop; {OWN}", 42),
    _figure(FORMATION, "consensus-delay", "sampled modes of the Laplacian", 30, "2 of 4 ages at 1 kHz", shares=(0.98, 1.02)),
    Check("wheels", BODIES, "Differential drives in PyBullet and MuJoCo.", "what was commanded", "bodies:wheels"),
    Check("quadrotor", BODIES, "Steady flight, limits, wind.", "balance of forces", "bodies:quadrotor", 4),
    Check("scanner", BODIES, "Beams in a room and among pillars.", "exact geometry", "bodies:scanner"),
    Check("inertial", BODIES, "An inertial unit on a circle.", "v w and g", "bodies:inertial"),
    Check("positions", BODIES, "Errors of positioning.", "what its parameters say", "bodies:positions"),
    _figure(AVOIDANCE, "28", f"{TOH}, Fig. 28; {OWN}", 4),
    _figure(AVOIDANCE, "29", f"{TOH}, Fig. 29; {OWN}", 10),
    _figure(AVOIDANCE, "41", f"{TOH}, Figs. 40 and 41; geometry", 19),
    _figure(AVOIDANCE, "42", f"{TOH}, Fig. 42", 7),
    _figure(AVOIDANCE, "43", f"{TOH}, Fig. 43", 6),
    _figure(AVOIDANCE, "stall", OWN, 3),
    _figure(AVOIDANCE, "levels", OWN, 4),
    _figure(AVOIDANCE, "passage-policies", OWN, 46),
    _figure(AVOIDANCE, "54", f"{TOH}, Fig. 54", 25),
    _figure(SEARCH, "45", f"{TOH}, Fig. 45", 4),
    _figure(SEARCH, "46", f"{TOH}, Fig. 46", 8),
    _figure(SEARCH, "47", f"{TOH}, Fig. 47", 14),
    _figure(SEARCH, "51", f"{TOH}, Figs. 49 to 51", 75, "2 of 3 towns", seeds=(1, 2)),
    _figure(SEARCH, "search-exchange", f"a cell's test, exactly; {OWN}", 150, "2 of 4 losses", losses=(0.0, 0.6)),
    _figure(SEARCH, "recognition", OWN, 30),
)

CHECKS: Mapping[str, Check] = {check.name: check for check in _ALL}


def chosen(names: Sequence[str]) -> Sequence[Check]:
    """The checks of these names; without names, all.

    Raises:
        UsageError: an unknown name.
    """
    for name in names:
        if name not in CHECKS:
            raise UsageError(f"vcmvsp validate --only {name}: {unknown('check', name, CHECKS)}")
    return [check for check in CHECKS.values() if not names or check.name in names]
