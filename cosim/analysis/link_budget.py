"""The link budget of one frame of a run.

::

    level = power + antenna gains - path loss - walls - shadowing + fading + changes by script or trace
    SINR  = level / (noise + interference)
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis.coverage import site_of
from vcmvsp.cosim.analysis.links import NUMBERS, UNDER_WAY, Frames, Log, Pair
from vcmvsp.cosim.analysis.loss_cause import why
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader

_NEGLIGIBLE_DB = 1e-6
Budget = dict[str, Any]


def frame_report(log: Log, pair: Pair, which: str, *, with_scenario: bool = True) -> dict[str, Any]:
    """One frame of a link.

    Args:
        log: of the run.
        pair: sender, receiver.
        which: the frame's number; ``lost``, the first that was lost; ``worst``, the one with the lowest SINR on the air.
        with_scenario: build the run's radio, too, which knows what the receiver needs. It may take longer than all the rest.

    Raises:
        UsageError: there is no such frame on this link.
    """
    frames = log.frames(pair)
    frame = frames.where(np.arange(len(frames)) == _find(log, frames, pair, which))
    row: dict[str, Any] = {name: frame[name].tolist()[0] for name in NUMBERS}
    outcome, materials = frame.words("outcome")[0], frame.words("wall_materials")[0]
    if row["received_ns"] > log.facts.end_ns:
        outcome = UNDER_WAY
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
    return {**report, "why": why(report)}


def _find(log: Log, frames: Frames, pair: Pair, which: str) -> int:
    """Place of the frame among those of the link."""
    link, numbers = "/".join(pair), frames["frame"]
    if not len(frames):
        raise UsageError(f"--frame {which}: {pair[0]} sent no frame that was meant for {pair[1]}")
    if which == "worst":
        on_air = np.where(frames["air_time_ns"] > 0, frames["sinr_db"], np.nan)
        if np.isnan(on_air).all():
            raise UsageError(f"--frame worst: no frame on {link} has a SINR: name one by its number, or ask for the first lost")
        return int(np.nanargmin(on_air))
    if which == "lost":
        lost = np.flatnonzero(~frames["under_way"] & (frames["received_ns"] < 0))
        if not lost.size:
            raise UsageError(f"--frame lost: no frame was lost on {link}")
        return int(lost[0])
    if not which.isdecimal():
        raise UsageError(f"--frame {which}: must be a frame's number, lost or worst")
    found = np.flatnonzero(numbers == int(which))
    if not found.size:
        others = [each for each in log.pairs() if each != pair and (log.frames(each)["frame"] == int(which)).any()]
        where = f"{others[0][0]} sent it to {', '.join(to for _, to in others)}" if others else "there is none"
        has = f"{link} has {len(frames)} frames, from {numbers.min()} to {numbers.max()}"
        raise UsageError(f"--frame {which}: is not on this link: {where}; {has}")
    return int(found[0])


def _radio(log: Log, pair: Pair) -> dict[str, Any] | None:
    """What the resolved scenario, if it is there, says of the radios of a link."""
    path = log.folder / "scenario.toml"
    if not path.is_file():
        return None
    site = site_of(*loader.load(path))
    if not all(name in site.radios for name in pair):
        return None
    phy, sender, receiver = site.channel.phy, site.radios[pair[0]], site.radios[pair[1]]
    hearing, least_dbm = site.channel.hearing, site.channel.budgets.least_dbm
    sensitivity = least_dbm if receiver.sensitivity_dbm is None else receiver.sensitivity_dbm
    return {
        "power_dbm": phy.tx_power_dbm if sender.tx_power_dbm is None else sender.tx_power_dbm,
        "gains_dbi": (sender.antenna_gain_dbi, receiver.antenna_gain_dbi),
        "floor_dbm": max(sensitivity, preamble_dbm := hearing.noise_dbm + hearing.preamble_db),
        "floor": "the sensitivity" if sensitivity >= preamble_dbm else "what the preamble needs",
        "errors": getattr(phy, "errors", None),
    }


def _budget(row: Mapping[str, Any], radio: Mapping[str, Any] | None) -> Budget:
    """The items of the budget; gains are positive, losses negative. Without a scenario, power is what the rest leaves."""
    losses = -row["path_loss_db"] - row["wall_loss_db"] - row["shadowing_db"] + row["fading_db"]
    rest = row["rssi_dbm"] - losses
    noise_dbm = row["rssi_dbm"] - row["snr_db"]
    sinr_db = None if math.isnan(row["sinr_db"]) else row["sinr_db"]
    more_db = 0.0 if sinr_db is None else row["snr_db"] - sinr_db  # so much stronger than noise are noise and interference
    budget = {"power_dbm": rest, "tx_gain_dbi": None, "rx_gain_dbi": None}
    if radio is not None:
        tx_gain, rx_gain = radio["gains_dbi"]
        budget = {"power_dbm": radio["power_dbm"], "tx_gain_dbi": tx_gain, "rx_gain_dbi": rx_gain}
    changes_db = rest - sum(value for value in budget.values() if value is not None)
    floor_dbm = None if radio is None else radio["floor_dbm"]
    return {
        **budget,
        "path_loss_db": -row["path_loss_db"],
        "walls_db": -row["wall_loss_db"],
        "shadowing_db": -row["shadowing_db"],
        "fading_db": row["fading_db"],
        "changes_db": changes_db,
        "rssi_dbm": row["rssi_dbm"],
        "noise_dbm": noise_dbm,
        "interference_dbm": noise_dbm + 10.0 * math.log10(10.0 ** (more_db / 10.0) - 1.0) if more_db > _NEGLIGIBLE_DB else None,
        "snr_db": row["snr_db"],
        "sinr_db": sinr_db,
        "floor": None if radio is None else radio["floor"],
        "floor_dbm": floor_dbm,
        "margin_db": None if floor_dbm is None else row["rssi_dbm"] - floor_dbm,
    }


def _survival(row: Mapping[str, Any], radio: Mapping[str, Any] | None) -> float | None:
    """Chance that the frame survives its SINR, were it that all the time."""
    if radio is None or radio["errors"] is None or math.isnan(row["sinr_db"]):
        return None
    return float(radio["errors"].frame_success(np.array([row["sinr_db"]]), row["size_bytes"])[0])
