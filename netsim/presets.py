"""Presets of the channel: named tables of layer parameters, which a scenario may change key by key."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

from vcmvsp.cosim.errors import ScenarioError

LAYERS = (
    "path_loss",
    "walls",
    "shadowing",
    "fading",
    "phy",
    "mac",
    "script",
    "trace",
    "jammer",
    "loss",
    "delay",
    "delivery",
)

Tables = dict[str, dict[str, Any]]

# Layers without effect in presets; numbers can be set without naming a kind: ``radio.loss.probability = 0.2``.
_LEFT_OUT: Tables = {
    "shadowing": {"kind": "gudmundson", "sigma_db": 0.0, "correlation_distance_m": 10.0},
    **{layer: {"kind": "none"} for layer in ("fading", "script", "trace", "jammer", "delivery")},
    "loss": {"kind": "bernoulli", "probability": 0.0},
    "delay": {"kind": "fixed", "seconds": 0.0, "jitter_s": 0.0},
}
# No bandwidth: 1 us + 1 ns a bit on the air, no contention.
_INSTANT: Tables = {
    "phy": {"kind": "constant_rate", "rate_bps": 1e9, "overhead_s": 1e-6, "tx_power_dbm": 0.0, "sensitivity_dbm": -300.0},
    "mac": {"kind": "ideal"},
}
_N_MBPS = 6.5, 13, 19.5, 26, 39, 52, 58.5, 65
_AX_MBPS = 8.6, 17.2, 25.8, 34.4, 51.6, 68.8, 77.4, 86, 103.2, 114.7, 129, 143.4
_AG_MBPS = 6, 9, 12, 18, 24, 36, 48, 54


def _indoor(frequency_hz: float, reference_loss_db: float) -> Tables:
    """Exponent 3 (ns-3's default) behind a metre of free space, and walls of the world's materials."""
    law = {"kind": "log_distance", "exponent": 3.0, "reference_distance_m": 1.0, "reference_loss_db": reference_loss_db}
    return {"path_loss": law, "walls": {"kind": "itu", "frequency_hz": frequency_hz}}


def _lora(spreading_factor: int) -> Tables:
    """LoRa at 14 dBm and with a duty cycle of 1 %, as in the European band of 868 MHz; one packet waits in the modem."""
    phy = {"kind": "lora", "spreading_factor": spreading_factor}
    return {**_indoor(868e6, 31.218), "phy": phy, "mac": {"kind": "aloha", "duty_cycle": 0.01, "queue_frames": 1}, **_LEFT_OUT}


def _wifi(
    letter: str, rates_mbps: Sequence[float], frequency_hz: float, reference_loss_db: float, kind: str = "ofdm", **band: str
) -> dict[str, Tables]:
    """802.11 at each rate, with the power, the preamble threshold and the channel access of ns-3."""
    indoor, presets = _indoor(frequency_hz, reference_loss_db), dict[str, Tables]()
    for rate in rates_mbps:
        phy = {"kind": kind, "rate_bps": rate * 1e6, **band, "tx_power_dbm": 16.0206, "sensitivity_dbm": -82.0}
        presets[f"wifi-{letter}-{rate:g}"] = {**indoor, "phy": phy, "mac": {"kind": "dcf"}, **_LEFT_OUT}
    return presets


_PRESETS: dict[str, Tables] = {
    # Every radio receives every frame, 1 us + 1 ns a bit after sending.
    "ideal": {"path_loss": {"kind": "none"}, "walls": {"kind": "none"}, **_INSTANT, **_LEFT_OUT},
    # The USARSim Wireless Simulation Server with its defaults: ePdo -49.67 dBm at eDo 2 m, eN 1 (range 43 km), eCutoff -93
    # dBm, eAttenFac 6.325 dB for every obstacle. It gives the received level at d0; sent at 0 dBm, the loss at d0 is its
    # negative. It has no bandwidth.
    "wss": {
        "path_loss": {
            "kind": "log_distance",
            "exponent": 1.0,
            "reference_distance_m": 2.0,
            "reference_loss_db": 49.67,
            "clamp": False,
        },
        "walls": {"kind": "fixed", "wall_db": 6.325},
        "phy": {**_INSTANT["phy"], "sensitivity_dbm": -93.0},
        "mac": _INSTANT["mac"],
        **_LEFT_OUT,
    },
    **_wifi("b", (1, 2, 5.5, 11), 2.4e9, 40.052, kind="dsss"),
    **_wifi("g", _AG_MBPS, 2.4e9, 40.052, band="2.4GHz"),
    **_wifi("a", _AG_MBPS, 5.15e9, 46.684, band="5GHz"),
    **_wifi("n", _N_MBPS, 2.4e9, 40.052, band="2.4GHz"),
    **_wifi("ax", _AX_MBPS, 2.4e9, 40.052, band="2.4GHz"),
    # 802.15.4 at 1 mW, with the sensitivity that the standard requires.
    "zigbee": {
        **_indoor(2.4e9, 40.052),
        "phy": {"kind": "ieee802154", "tx_power_dbm": 0.0, "sensitivity_dbm": -85.0},
        "mac": {"kind": "csma154"},
        **_LEFT_OUT,
    },
    **{f"lora-sf{factor}": _lora(factor) for factor in range(7, 13)},
}

PRESETS = tuple(_PRESETS)


def preset(name: str) -> Tables:
    """The layers of a preset: ``{"path_loss": {"kind": ..., parameters}, ...}`` for all `LAYERS`, as a copy."""
    if name not in _PRESETS:
        raise ScenarioError(f"unknown preset {name!r}; presets: {', '.join(PRESETS)}", key="preset")
    return {layer: deepcopy(_PRESETS[name][layer]) for layer in LAYERS}
