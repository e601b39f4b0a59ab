"""Curves of the channel's models: packet errors by SNR, mean levels by distance."""

import dataclasses
import math
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Any

import numpy as np

from vcmvsp.cosim.errors import UsageError
from vcmvsp.netsim.channel.link_budget import ReceiverModel
from vcmvsp.netsim.interfaces.layers import Floats, PathLoss, Paths, Phy
from vcmvsp.netsim.phy.dsss import DsssErrors
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors
from vcmvsp.netsim.phy.ofdm import OfdmErrors

POINTS = 1_000_000  # of a curve, at most
OFDM_MODELS = ("table", "yans", "nist")
DSSS_MODELS = ("dsss", *OFDM_MODELS)  # all names of one model
ZIGBEE_MODELS = ("oqpsk",)
ANTENNA_HEIGHT_M = 0.5  # above the ground, if the path loss has no height


def grid(text: str, option: str) -> Floats:
    """``START:STOP:STEP`` as numbers: START, START + STEP, ..., with STOP if it is one of them (within 1e-9 steps)."""
    try:
        start, stop, step = (Decimal(part.strip()) for part in text.split(":"))
    except (InvalidOperation, ValueError):
        raise UsageError(f"{option} {text}: write START:STOP:STEP, three numbers, e.g. 0:10:0.5") from None
    if not all(value.is_finite() and math.isfinite(float(value)) for value in (start, stop, step)):
        raise UsageError(f"{option} {text}: all three numbers must be finite")
    if step == 0:
        raise UsageError(f"{option} {text}: STEP must not be 0")
    steps = (stop - start) / step
    if steps < 0:
        raise UsageError(f"{option} {text}: steps of {step} do not lead from {start} to {stop}; change the sign of STEP")
    if steps >= POINTS:
        raise UsageError(f"{option} {text}: {float(steps):.3g} points are too many (at most {POINTS}); use larger steps")
    return np.array([float(start + i * step) for i in range(int(steps + Decimal("1e-9")) + 1)])


def error_rate(phy: Phy, model: str) -> tuple[ErrorRate, str]:
    """Packet error model of a phy, and the model's name; ``default``: the phy's own."""
    errors: ErrorRate | None = getattr(phy, "errors", None)
    if isinstance(errors, OfdmErrors):
        name = _chosen(model, errors.model, OFDM_MODELS)
        return dataclasses.replace(errors, model=name), name  # type: ignore[arg-type]  # checked by _chosen
    if isinstance(errors, DsssErrors):
        return errors, _chosen(model, "dsss", DSSS_MODELS)
    if isinstance(errors, OqpskErrors):
        return errors, _chosen(model, "oqpsk", ZIGBEE_MODELS)
    raise UsageError(f"{type(phy).__name__} has no packet-error model; choose a preset of 802.11 (wifi-...) or zigbee")


def _chosen(model: str, default: str, models: Sequence[str]) -> str:
    if model not in ("default", *models):
        raise UsageError(f"--model {model}: this preset allows default, {', '.join(models)}")
    return default if model == "default" else model


def packet_errors(errors: ErrorRate, snr_db: Floats, size_bytes: int) -> dict[str, list[float]]:
    """Probabilities of reception (``success``) and loss (``per``) of a frame with this payload at constant SNR, (n,).

    They are of the whole frame, header included; ``payload_success`` is of the bits after the header only.
    """
    hazard = errors.frame_hazard(snr_db, size_bytes)
    payload, bits = errors.payload(size_bytes)
    return {
        "snr_db": snr_db.tolist(),
        "success": np.exp(-hazard).tolist(),
        "per": (-np.expm1(-hazard)).tolist(),
        "payload_success": payload.success(snr_db, bits).tolist(),
    }


def mean_levels(path_loss: PathLoss, phy: Phy, distance_m: Floats) -> dict[str, list[float]]:
    """Loss, received level and SNR over distances (n,), by the path loss alone: no walls, shadowing or fading.

    Antennas have no gain and the height ``path_loss.antenna_height_m`` if the path loss has one, else 0.5 m.
    """
    height = float(getattr(path_loss, "antenna_height_m", ANTENNA_HEIGHT_M))
    rx = np.stack([distance_m, np.zeros(len(distance_m)), np.full(len(distance_m), height)], axis=-1)
    loss_db = path_loss.loss_db(Paths(np.array([0.0, 0.0, height]), rx, distance_m))
    rssi_dbm = phy.tx_power_dbm - loss_db
    curves: dict[str, Any] = {"distance_m": distance_m, "path_loss_db": loss_db, "rssi_dbm": rssi_dbm}
    curves["snr_db"] = rssi_dbm - ReceiverModel(phy, -math.inf).noise_dbm
    return {name: values.tolist() for name, values in curves.items()}
