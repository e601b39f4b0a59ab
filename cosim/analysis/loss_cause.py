"""What became of a frame, in a sentence."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Report = Mapping[str, Any]  # of one frame, see `cosim.analysis.link_budget`
_HEARS_ALL_DBM = -200.0


def why(report: Report) -> str:
    """The outcome, and what would have had to be different."""
    outcome = report["outcome"]
    if outcome == "under way":
        return "under way: the run ended before it had arrived"
    if not report["air_time_s"]:
        return f"lost: {outcome}: it had waited {1e3 * report['queue_s']:.3f} ms and was never sent"
    if outcome == "received":
        return _received(report)
    return f"lost: {outcome}: {_CAUSES.get(outcome, _behind)(report)}"


def _received(report: Report) -> str:
    parts = {"queue": report["queue_s"], "access": report["access_s"], "on the air": report["air_time_s"]}
    parts["behind the radio"] = report["delay_s"] - sum(parts.values())
    spent = ", ".join(f"{name} {1e3 * s:.3f}" for name, s in parts.items() if s > 0.5e-9)
    return f"received {1e3 * report['delay_s']:.3f} ms after it was sent ({spent}), at {_level(report)}"


def _too_far(report: Report) -> str:
    budget = report["budget"]
    open_dbm = budget["rssi_dbm"] - budget["walls_db"] - budget["shadowing_db"] - budget["fading_db"]
    return f"{report['distance_m']:.1f} m alone leave {open_dbm:.1f} dBm{_beside(open_dbm, budget)}"


def _without(item: str, words: Callable[[Report], str], later: Sequence[str] = ()) -> Callable[[Report], str]:
    """What the level would have been without one item of the budget; if still too low, without the ``later`` items too."""

    def say(report: Report) -> str:
        budget = report["budget"]
        level_dbm = budget["rssi_dbm"] - budget[item]
        name = f"without {words(report)} ({-budget[item]:.1f} dB)"
        if not later or budget["floor_dbm"] is None or level_dbm >= budget["floor_dbm"]:
            return f"{name} it would have been {level_dbm:.1f} dBm{_beside(level_dbm, budget)}"
        level_dbm -= sum(budget[each] for each in later)
        also = " and ".join(f"{each[:-3]} ({-budget[each]:.1f} dB)" for each in later)
        return f"{name}, and without {also}, it would have been {level_dbm:.1f} dBm{_beside(level_dbm, budget)}"

    return say


def _walls(report: Report) -> str:
    kinds = report["wall_materials"].replace(", ", " and ")
    return f"the {kinds} {'wall' if report['walls'] == 1 else 'walls'}" if kinds else "the walls"


def _disturbed(report: Report) -> str:
    budget = report["budget"]
    return f"its SNR of {budget['snr_db']:.1f} dB became a SINR of {_sinr(budget)}"


def _error(report: Report) -> str:
    survival = report["survival"]
    chance = "" if survival is None else f", which {100.0 * survival:.1f} % of such frames survive"
    return f"bits were wrong at a SINR of {_sinr(report['budget'])}{chance}"


def _behind(report: Report) -> str:
    return f"not the radio's doing, which had received it at {_level(report)}"


_CAUSES: Mapping[str, Callable[[Report], str]] = {
    "below sensitivity": _too_far,
    "walls": _without("walls_db", _walls, ("shadowing_db", "fading_db")),
    "shadowing": _without("shadowing_db", lambda _: "the shadowing", ("fading_db",)),
    "fading": _without("fading_db", lambda _: "the fading"),
    "script": lambda report: f"a change of the script left {_level(report)}",
    "trace": lambda report: f"the trace says {_level(report)}",
    "outage": lambda report: f"the operator had cut off its sender or receiver; the frame came at {_level(report)}",
    "collision": _disturbed,
    "jammed": _disturbed,
    "packet error": _error,
    "receiver transmitting": lambda report: f"it was sending itself when the frame came at {_level(report)}",
}


def _sinr(budget: Report) -> str:
    return "unknown height" if budget["sinr_db"] is None else f"{budget['sinr_db']:.1f} dB"


def _level(report: Report) -> str:
    budget = report["budget"]
    return f"{budget['rssi_dbm']:.1f} dBm{_beside(budget['rssi_dbm'], budget)}"


def _beside(level_dbm: float, budget: Report) -> str:
    """How far a level is from the weakest that is noticed."""
    floor_dbm = budget["floor_dbm"]
    if floor_dbm is None or floor_dbm < _HEARS_ALL_DBM:
        return ""
    return f", {abs(level_dbm - floor_dbm):.1f} dB {'above' if level_dbm >= floor_dbm else 'below'} {budget['floor']}"
