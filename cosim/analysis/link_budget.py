"""Link budget of one frame of a run, and the reason for its reception or loss as a sentence.

::

    level = power + antenna gains - path loss - walls - shadowing + fading + changes by script or trace
    SINR  = level / (noise + interference)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import ray_paths
from vcmvsp.cosim.analysis.coverage import without_own_layers
from vcmvsp.cosim.analysis.links import NUMBERS, LinkFrames, Log, Pair
from vcmvsp.cosim.assembly.radio import channel_of
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.registry import NO_CODE, only
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY

Budget = dict[str, Any]
Report = Mapping[str, Any]  # see `frame_report`
_NEGLIGIBLE_DB = 1e-6
_HEARS_ALL_DBM = -200.0


def frame_report(log: Log, pair: Pair, which: str, *, with_scenario: bool = True, trust: bool = False) -> dict[str, Any]:
    """One frame of a link: budget, times, outcome and reason.

    Args:
        log: frames of the run.
        pair: sender, receiver.
        which: the frame's number; ``lost``: the first lost frame; ``worst``: the frame with the lowest SINR on the air.
        with_scenario: also build the run's radio, for the level that the receiver needs. This may take longest.
        trust: import radio classes of the scenario that are not built in; without it, such a ``phy`` is not described.

    Raises:
        UsageError: the link has no such frame.
    """
    frames = log.frames(pair)
    frame = frames.select(np.arange(len(frames)) == _find(log, frames, pair, which))
    row: dict[str, Any] = {name: frame[name].tolist()[0] for name in NUMBERS}
    outcome, materials = frame.words("outcome")[0], frame.words("wall_materials")[0]
    with only(None if trust else NO_CODE):
        radio = _radio(log, pair) if with_scenario else None
    report = {
        "sender": pair[0],
        "receiver": pair[1],
        "frame": row["frame"],
        "sent_s": row["sent_ns"] / SECOND_NS,
        "size_bytes": row["size_bytes"],
        "distance_m": row["distance_m"],
        "walls": row["walls"],
        "wall_materials": materials,
        "budget": _budget(row, radio),
        "queue_s": row["queue_ns"] / SECOND_NS,
        "access_s": row["access_ns"] / SECOND_NS,
        "air_time_s": row["air_time_ns"] / SECOND_NS,
        "delay_s": None if row["delay_ns"] < 0 else row["delay_ns"] / SECOND_NS,
        "survival": _survival(row, radio),
        "outcome": outcome,
    }
    paths = _paths(log, pair, row["sent_ns"], report["budget"], trust=trust) if with_scenario else []
    if paths:
        report["paths"] = paths
    report["why"] = why(report)
    return report


def _paths(log: Log, pair: Pair, sent_ns: int, budget: Budget, *, trust: bool) -> list[dict[str, Any]]:
    """The paths of rays with their levels, dBm, the strongest first."""
    if not (log.folder / "scenario.toml").is_file():
        return []
    sent_dbm = sum(budget[name] or 0.0 for name in ("power_dbm", "tx_gain_dbi", "rx_gain_dbi"))
    rows = ray_paths.of_frame(log.folder, pair, sent_ns, trust=trust)
    return [{**row, "level_dbm": sent_dbm + row["gain_db"]} for row in rows]


def _find(log: Log, frames: LinkFrames, pair: Pair, which: str) -> int:
    link, numbers = "/".join(pair), frames["frame"]
    if not len(frames):
        raise UsageError(f"--frame {which}: {pair[0]} sent no frame to {pair[1]}")
    if which == "worst":
        on_air = np.where(frames["air_time_ns"] > 0, frames["sinr_db"], np.nan)
        if np.isnan(on_air).all():
            raise UsageError(f"--frame worst: no frame on {link} has a SINR: give a frame number, or --frame lost")
        return int(np.nanargmin(on_air))
    if which == "lost":
        lost = np.flatnonzero(~frames["under_way"] & (frames["received_ns"] < 0))
        if not lost.size:
            raise UsageError(f"--frame lost: no frame was lost on {link}")
        return int(lost[0])
    if not which.isdecimal():
        raise UsageError(f"--frame {which}: must be a frame's number, lost or worst")
    matches = np.flatnonzero(numbers == int(which))
    if not matches.size:
        whole = Log(log.folder)
        others = [each for each in whole.pairs() if each != pair and (whole.frames(each)["frame"] == int(which)).any()]
        receivers = ", ".join(receiver for _, receiver in others)
        where = f"{others[0][0]} sent it to {receivers}" if others else "no such frame"
        has = f"{link} has {len(frames)} frames, from {numbers.min()} to {numbers.max()}"
        raise UsageError(f"--frame {which}: not a frame of this link: {where}; {has}")
    return int(matches[0])


def _radio(log: Log, pair: Pair) -> dict[str, Any] | None:
    """Radios of a link according to the resolved scenario, if available."""
    path = log.folder / "scenario.toml"
    if not path.is_file():
        return None
    parsed, source = loader.load(path)
    if parsed.radios:
        return None
    importable, own = without_own_layers(parsed)
    channel, radios, _ = channel_of(importable, source, solids=())
    if "radio.phy" in own or not all(name in radios for name in pair):
        return None
    phy, sender, receiver = channel.phy, radios[pair[0]], radios[pair[1]]
    power_dbm = phy.tx_power_dbm if sender.tx_power_dbm is None else sender.tx_power_dbm
    sensitivity = channel.budgets.least_dbm if receiver.sensitivity_dbm is None else receiver.sensitivity_dbm
    preamble_dbm = channel.hearing.noise_dbm + channel.hearing.preamble_db
    return {
        "power_dbm": power_dbm,
        "gains_dbi": (sender.antenna_gain_dbi, receiver.antenna_gain_dbi),
        "floor_dbm": max(sensitivity, preamble_dbm),
        "floor": "the sensitivity" if sensitivity >= preamble_dbm else "the preamble's threshold",
        "errors": getattr(phy, "errors", None),
    }


def _budget(row: Mapping[str, Any], radio: Mapping[str, Any] | None) -> Budget:
    """The items of the budget; gains are positive, losses negative. Without a scenario, power is the remainder."""
    losses = -row["path_loss_db"] - row["wall_loss_db"] - row["shadowing_db"] + row["fading_db"]
    rest = row["rssi_dbm"] - losses
    noise_dbm = row["rssi_dbm"] - row["snr_db"]
    sinr_db = None if math.isnan(row["sinr_db"]) else row["sinr_db"]
    interference_dbm = None
    more_db = 0.0 if sinr_db is None else row["snr_db"] - sinr_db  # ratio of noise and interference to noise
    if more_db > _NEGLIGIBLE_DB:
        interference_dbm = noise_dbm + 10.0 * math.log10(10.0 ** (more_db / 10.0) - 1.0)
    budget = {"power_dbm": rest, "tx_gain_dbi": None, "rx_gain_dbi": None}
    floor = floor_dbm = margin_db = None
    if radio is not None:
        tx_gain, rx_gain = radio["gains_dbi"]
        budget = {"power_dbm": radio["power_dbm"], "tx_gain_dbi": tx_gain, "rx_gain_dbi": rx_gain}
        floor, floor_dbm = radio["floor"], radio["floor_dbm"]
        margin_db = row["rssi_dbm"] - floor_dbm
    changes_db = rest - sum(value for value in budget.values() if value is not None)
    return {
        **budget,
        "path_loss_db": -row["path_loss_db"],
        "walls_db": -row["wall_loss_db"],
        "shadowing_db": -row["shadowing_db"],
        "fading_db": row["fading_db"],
        "changes_db": changes_db,
        "rssi_dbm": row["rssi_dbm"],
        "noise_dbm": noise_dbm,
        "interference_dbm": interference_dbm,
        "snr_db": row["snr_db"],
        "sinr_db": sinr_db,
        "floor": floor,
        "floor_dbm": floor_dbm,
        "margin_db": margin_db,
    }


def _survival(row: Mapping[str, Any], radio: Mapping[str, Any] | None) -> float | None:
    if radio is None or radio["errors"] is None or math.isnan(row["sinr_db"]):
        return None
    return float(radio["errors"].frame_success(np.array([row["sinr_db"]]), row["size_bytes"])[0])


def why(report: Report) -> str:
    """The outcome as a sentence, with the change that would have reversed it."""
    outcome = report["outcome"]
    if outcome == UNDER_WAY:
        return "under way: the run ended before the frame arrived"
    if not report["air_time_s"]:
        return f"lost: {outcome}: it waited {1e3 * report['queue_s']:.3f} ms and was not sent"
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
    span = f"{report['distance_m']:.1f} m"
    cause = f"all paths over {span}" if "paths" in report else f"{span} alone"
    return f"{cause} leave {open_dbm:.1f} dBm{_beside(open_dbm, budget)}"


def _without(item: str, words: Callable[[Report], str], later: Sequence[str] = ()) -> Callable[[Report], str]:
    """Text on the level without one item of the budget; if still too low, without the ``later`` items too."""

    def say(report: Report) -> str:
        budget = report["budget"]
        level_dbm = budget["rssi_dbm"] - budget[item]
        name = f"without {words(report)} ({-budget[item]:.1f} dB)"
        if not later or budget["floor_dbm"] is None or level_dbm >= budget["floor_dbm"]:
            return f"{name} the level would be {level_dbm:.1f} dBm{_beside(level_dbm, budget)}"
        level_dbm -= sum(budget[each] for each in later)
        also = " and ".join(f"{each[:-3]} ({-budget[each]:.1f} dB)" for each in later)
        return f"{name}, and without {also}, the level would be {level_dbm:.1f} dBm{_beside(level_dbm, budget)}"

    return say


def _walls(report: Report) -> str:
    kinds = report["wall_materials"].replace(", ", " and ")
    noun = "wall" if report["walls"] == 1 else "walls"
    return f"the {kinds} {noun}" if kinds else "the walls"


def _disturbed(report: Report) -> str:
    budget = report["budget"]
    return f"interference reduced its SNR of {budget['snr_db']:.1f} dB to a SINR of {_sinr(budget)}"


def _error(report: Report) -> str:
    survival = report["survival"]
    chance = "" if survival is None else f", which {100.0 * survival:.1f} % of such frames survive"
    return f"bit errors at a SINR of {_sinr(report['budget'])}{chance}"


def _behind(report: Report) -> str:
    return f"lost behind the radio, which received it at {_level(report)}"


_CAUSES: Mapping[str, Callable[[Report], str]] = {
    "below sensitivity": _too_far,
    "walls": _without("walls_db", _walls, ("shadowing_db", "fading_db")),
    "shadowing": _without("shadowing_db", lambda _: "the shadowing", ("fading_db",)),
    "fading": _without("fading_db", lambda _: "the fading"),
    "script": lambda report: f"with the change of the script, the level was {_level(report)}",
    "trace": lambda report: f"the level of the trace was {_level(report)}",
    "outage": lambda report: f"the operator had cut off its sender or receiver; the level was {_level(report)}",
    "collision": _disturbed,
    "jammed": _disturbed,
    "packet error": _error,
    "receiver transmitting": lambda report: f"the receiver was transmitting; the level was {_level(report)}",
}


def _sinr(budget: Budget) -> str:
    return "unknown height" if budget["sinr_db"] is None else f"{budget['sinr_db']:.1f} dB"


def _level(report: Report) -> str:
    budget = report["budget"]
    return f"{budget['rssi_dbm']:.1f} dBm{_beside(budget['rssi_dbm'], budget)}"


def _beside(level_dbm: float, budget: Budget) -> str:
    floor_dbm = budget["floor_dbm"]
    if floor_dbm is None or floor_dbm < _HEARS_ALL_DBM:
        return ""
    return f", {abs(level_dbm - floor_dbm):.1f} dB {'above' if level_dbm >= floor_dbm else 'below'} {budget['floor']}"
