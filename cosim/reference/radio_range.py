"""How far a preset of the radio reaches, for the reference."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.config import binding, registry

RANGE_BYTES = 100


def reach_m(preset: Mapping[str, Mapping[str, Any]]) -> float:
    """Where the level is the least at which half of all frames are received: ``d0 10^((P - L0 - S) / (10 N))``.

    S is the sensitivity or, where that is more, the level that the preamble's or the payload's ratio to the noise needs.
    """
    law, mac = _complete("path_loss", preset), _complete("mac", preset)
    if law["kind"] != "log_distance":
        return math.inf if law["kind"] == "none" else math.nan
    phy = binding.call(registry.find("phy", preset["phy"]["kind"]), params(preset["phy"]))
    noise_dbm, errors = getattr(phy, "noise_dbm", -math.inf), getattr(phy, "errors", None)
    snr_db = mac.get("preamble_snr_db", getattr(phy, "preamble_snr_db", -math.inf))
    if errors is not None:
        ratios_db = np.arange(-20.0, 40.0, 1e-3)
        snr_db = max(snr_db, ratios_db[np.argmax(errors.frame_success(ratios_db, RANGE_BYTES) >= 0.5)])
    sensitivity_dbm = -math.inf if mac["kind"] == "csma154" else phy.sensitivity_dbm  # there it is no threshold
    margin_db = phy.tx_power_dbm - law["reference_loss_db"] - max(sensitivity_dbm, noise_dbm + snr_db)
    return float(law["reference_distance_m"] * 10.0 ** (margin_db / (10.0 * law["exponent"])))


def _complete(layer: str, preset: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    content = preset[layer]
    return {**content, **binding.complete(registry.find(layer, content["kind"]), params(content))}


def params(content: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a table but for its kind."""
    return {name: value for name, value in content.items() if name != "kind"}
