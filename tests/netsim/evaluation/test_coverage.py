"""Coverage: the same as what the channel reports to a receiver that stands there, and closed forms."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.types import Message, Vec3
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation.coverage import among, coverage, floor_dbm, range_m
from vcmvsp.netsim.interfaces.radio import Radio
from vcmvsp.physics.world.solids import Box

Floats = NDArray[np.float64]
BOXES = (
    Box(center=(10.0, 0.0, 1.25), size=(0.11, 16.0, 2.5), material="brick"),
    Box(center=(20.0, 2.0, 1.25), size=(0.2, 20.0, 2.5), yaw_rad=0.4, material="concrete"),
    Box(center=(30.0, 8.0, 0.2), size=(2.0, 2.0, 0.4), material="wood"),
)
SHADOWED: dict[str, Any] = {"shadowing": {"sigma_db": 4.0}}
SEED = 5


def make(preset: str = "wifi-b-1", radios: Mapping[str, Radio] | None = None, **layers: dict[str, Any]) -> Channel:
    """A channel among the boxes, without contention."""
    tables = {"preset": preset, "mac": {"kind": "ideal"}, **layers}
    channel: Channel = radio.build(tables, Source("test", Path()), solids=BOXES, radios=radios)[0]
    channel.start(SEED)
    return channel


def reported(channel: Channel, sender: str, places: Mapping[str, Vec3], frames: int = 1) -> tuple[Floats, Floats]:
    """Mean level and share of receptions by sending frames, (n,) each."""
    names, position = tuple(places), np.array(list(places.values()))
    levels, received = [], []
    for k in range(frames):
        (report,) = channel.send(k * 10_000_000, Message(sender=sender, body={}, size_bytes=100), names, position)
        levels.append(report.rssi_dbm - (0.0 if report.fading_db is None else report.fading_db))
        received.append(report.received_ns >= 0)
    return np.mean(levels, axis=0), np.mean(received, axis=0)


def test_the_level_is_what_the_channel_reports_to_a_receiver_that_stands_there() -> None:
    rng = np.random.default_rng(1)
    antennas = np.column_stack([rng.uniform(-40.0, 60.0, (40, 2)), np.full(40, 0.5)])
    car: Vec3 = (1.0, -2.0, 0.0)
    radios = {"car": Radio(tx_power_dbm=20.0, antenna_gain_dbi=3.0, antenna_height_m=0.8)}
    found = coverage(make(radios=radios, **SHADOWED), "car", np.array(car), antennas, seed=SEED)
    there = {f"r{k}": tuple(place) for k, place in enumerate(antennas.tolist())}  # at the antenna: no radio of its own
    level, received = reported(make(radios=radios, **SHADOWED), "car", {"car": car, **there})
    np.testing.assert_allclose(found.level_dbm, level, atol=1e-9)
    sure = (found.success < 1e-12) | (found.success > 1.0 - 1e-12)
    assert sure.sum() > 30
    assert np.array_equal(found.success[sure] > 0.5, received[sure] > 0.5)


def test_vehicles_count_with_their_own_radios() -> None:
    places = {"a": (0.0, 0.0, 0.0), "b": (40.0, 1.0, 0.0), "c": (90.0, 0.0, 0.0)}
    radios = {"a": Radio(), "b": Radio(antenna_gain_dbi=2.0), "c": Radio(sensitivity_dbm=-89.0, antenna_height_m=2.0)}
    found = among(make(radios=radios), "a", places, seed=SEED)
    level, received = reported(make(radios=radios), "a", places)
    np.testing.assert_allclose(found.level_dbm, level, atol=1e-9)
    assert np.array_equal(found.success > 0.5, received > 0.5)


@pytest.mark.parametrize(
    "fading",
    [
        {"kind": "rayleigh"},
        {"kind": "nakagami", "m": 1.5},
        {"kind": "rician", "k_factor": 4.0},
        {"kind": "rayleigh", "doppler_hz": 40.0},
    ],
    ids=["rayleigh", "nakagami", "rician", "doppler"],
)
def test_the_chance_of_success_is_the_share_of_many_frames(fading: dict[str, Any]) -> None:
    layers = {"fading": fading, "walls": {"kind": "none"}, "phy": {"rate_bps": 54e6, "preamble_snr_db": 0.0}}
    antennas = np.array([(d, 0.0, 0.0) for d in (10.0, 30.0, 45.0, 60.0, 80.0, 100.0)])
    car: Vec3 = (0.0, 0.0, 0.0)
    found = coverage(make("wifi-g-54", **layers), "car", np.array(car), antennas, seed=SEED)
    there = {f"r{k}": tuple(place) for k, place in enumerate(antennas.tolist())}
    frames = 1500
    _, received = reported(make("wifi-g-54", **layers), "car", {"car": car, **there}, frames)
    noise = 4.5 * np.sqrt(0.25 / frames) * (3.0 if "doppler_hz" in fading else 1.0)  # a process repeats itself
    assert np.ptp(found.success) > 0.5
    np.testing.assert_allclose(found.success, received, atol=noise + 2.0 / 233)


def test_rayleigh_fading_over_a_threshold_in_closed_form() -> None:
    # P(level + g >= sensitivity) = exp(-10^((sensitivity - level) / 10)), g exponential with mean 1.
    phy = {"kind": "constant_rate", "tx_power_dbm": 16.0206, "sensitivity_dbm": -82.0}
    antennas = np.array([(d, 0.0, 0.0) for d in np.geomspace(1.0, 500.0, 200)])
    found = coverage(make(phy=phy, fading={"kind": "rayleigh"}), "car", np.zeros(3), antennas)
    np.testing.assert_allclose(found.success, np.exp(-(10.0 ** ((-82.0 - found.level_dbm) / 10.0))), atol=1.0 / 233)


def test_levels_are_the_same_in_both_directions() -> None:
    channel, rng = make(**SHADOWED), np.random.default_rng(2)
    for a, b in zip(rng.uniform(-30.0, 50.0, (20, 3)), rng.uniform(-30.0, 50.0, (20, 3)), strict=True):
        forth = coverage(channel, "car", a, b[None], seed=SEED).level_dbm
        assert forth == pytest.approx(coverage(channel, "car", b, a[None], seed=SEED).level_dbm, abs=1e-9)


def test_a_place_is_the_same_whatever_else_is_asked() -> None:
    channel = make(**SHADOWED, fading={"kind": "rayleigh"})
    antennas = np.random.default_rng(3).uniform(-50.0, 50.0, (5000, 3))
    everywhere = coverage(channel, "car", np.zeros(3), antennas, seed=SEED)
    alone = coverage(channel, "car", np.zeros(3), antennas[4999:], seed=SEED)
    assert (everywhere.level_dbm[-1], everywhere.success[-1]) == (alone.level_dbm[0], alone.success[0])
    assert coverage(channel, "car", np.zeros(3), np.empty((0, 3))).level_dbm.shape == (0,)


def test_asking_changes_nothing_for_a_channel_that_is_in_use() -> None:
    layers: dict[str, Any] = {**SHADOWED, "fading": {"kind": "rayleigh"}}
    places = {"a": (0.0, 0.0, 0.0), "b": (40.0, 1.0, 0.0)}
    asked, other = make(**layers), make(**layers)
    for _ in range(3):
        coverage(asked, "a", np.ones(3), np.ones((4, 3)), seed=77)
        assert reported(asked, "a", places)[0] == reported(other, "a", places)[0]


def test_range_of_the_log_distance_law() -> None:
    # d0 10^((P - L0 - sensitivity) / (10 N)), 85.6 m for the preset.
    assert range_m(make(), "car", 0.0) == pytest.approx(10.0 ** ((16.0206 - 40.052 + 82.0) / 30.0), rel=0.012)
    assert range_m(make("wss"), "car", 0.0) is None  # 43 km
    assert range_m(make("ideal"), "car", 0.0) is None
    assert range_m(make(phy={"tx_power_dbm": -90.0}), "car", 0.0) == 0.0


def test_the_weakest_level_is_the_sensitivity_or_what_the_preamble_needs() -> None:
    noise_dbm = 10.0 * math.log10(1.380649e-23 * 290.0 * 20e6) + 30.0 + 7.0
    assert floor_dbm(make()) == -82.0
    assert floor_dbm(make(phy={"sensitivity_dbm": -100.0})) == pytest.approx(noise_dbm + 4.0, abs=1e-9)
