"""Named channels: a table of layer parameters each, which a scenario takes whole or changes key by key."""

from copy import deepcopy
from typing import Any

from cosim.errors import ScenarioError

LAYERS = ("path_loss", "phy", "loss", "delay")

_INDOOR = {"kind": "log_distance", "exponent": 3.0, "reference_distance_m": 1.0, "reference_loss_db": 40.052}
# Nothing is lost or late beyond the layers above, but both can be set: ``radio.loss.probability = 0.2``.
_NO_MORE: dict[str, dict[str, Any]] = {
    "loss": {"kind": "bernoulli", "probability": 0.0},
    "delay": {"kind": "fixed", "seconds": 0.0, "jitter_s": 0.0},
}

_PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    # Everybody hears everything, 1 us + 1 ns a bit after it was sent.
    "ideal": {
        "path_loss": {"kind": "none"},
        "phy": {"kind": "constant_rate", "rate_bps": 1e9, "overhead_s": 1e-6},
        **_NO_MORE,
    },
    # The USARSim Wireless Simulation Server, distance only, with its defaults: ePdo -49.67 dBm at eDo 2 m, eN 1 (range 43 km),
    # eCutoff -93 dBm. It gives the received level at d0; sent at 0 dBm, the loss at d0 is its negative. It has no bandwidth.
    "wss": {
        "path_loss": {"kind": "log_distance", "exponent": 1.0, "reference_distance_m": 2.0, "reference_loss_db": 49.67},
        "phy": {"kind": "constant_rate", "rate_bps": 1e9, "overhead_s": 1e-6, "tx_power_dbm": 0.0, "sensitivity_dbm": -93.0},
        **_NO_MORE,
    },
    # 802.11b at 1 Mbit/s with the power and the preamble threshold of ns-3: range 85.6 m.
    "wifi-b-1": {
        "path_loss": _INDOOR,
        "phy": {"kind": "dsss", "rate_bps": 1e6, "tx_power_dbm": 16.0206, "sensitivity_dbm": -82.0},
        **_NO_MORE,
    },
    # 802.15.4 at 1 mW and the sensitivity that the standard asks for: range 31.5 m.
    "zigbee": {
        "path_loss": _INDOOR,
        "phy": {"kind": "ieee802154", "tx_power_dbm": 0.0, "sensitivity_dbm": -85.0},
        **_NO_MORE,
    },
}

PRESETS = tuple(_PRESETS)


def preset(name: str) -> dict[str, dict[str, Any]]:
    """The layers of a preset: ``{"path_loss": {"kind": ..., parameters}, "phy": ..., "loss": ..., "delay": ...}``, to keep."""
    if name not in _PRESETS:
        raise ScenarioError(f"no preset is called {name!r}; presets: {', '.join(PRESETS)}", key="preset")
    return deepcopy(_PRESETS[name])
