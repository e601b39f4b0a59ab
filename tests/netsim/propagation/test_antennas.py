"""Antennas: half-wave dipole of the textbooks, patterns from files, and orientation with the vehicle."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.docs.readme_pages import block
from tests.support.netsim.ray_worlds import rays_among
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import NoDelay
from vcmvsp.netsim.impairments.loss import NoLoss
from vcmvsp.netsim.interfaces.layers import Floats, Radio
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.propagation.antennas import Dipole, read_pattern
from vcmvsp.netsim.propagation.path_loss import Friis

NAMES = ("a", "b", "c")
PLACES = np.array([(0.0, 0.0, 5.0), (10.0, 0.0, 5.0), (0.0, 3.0, 9.0)])
LEVEL = np.tile((1.0, 0.0, 0.0, 0.0), (3, 1))
PATTERN = "elevation_deg,azimuth_deg,gain_dbi\n"


def levels(path_loss: Any, places: Floats = PLACES, attitude: Floats | None = None, **of_a: Any) -> Floats:
    """Levels among three radios; the first has this antenna."""
    radios = {name: Radio(antenna_height_m=0.0, **(of_a if name == "a" else {})) for name in NAMES}
    channel = Channel(path_loss=path_loss, phy=Dsss(), loss=NoLoss(), delay=NoDelay(), radios=radios)
    return channel.levels_dbm(NAMES, places, attitude)


def pitched(angle: float) -> Floats:
    """The first vehicle, pitched down by an angle."""
    attitude = LEVEL.copy()
    attitude[0] = math.cos(0.5 * angle), 0.0, math.sin(0.5 * angle), 0.0
    return attitude


def test_a_dipole_radiates_all_its_power() -> None:
    """2.15 dBi across the axis, nothing along it, half of that at 39 degrees; the mean over the sphere is 1."""
    direction = np.array([(1.0, 0.0, 0.0), (0.0, math.cos(math.radians(39.0)), math.sin(math.radians(39.0))), (0.0, 0.0, 1.0)])
    gain = Dipole().gain(direction)
    assert 10.0 * math.log10(gain[0]) == pytest.approx(2.15, abs=0.01)
    assert gain[1] == pytest.approx(0.5 * gain[0], rel=0.01)
    assert gain[2] < 1e-12
    height = (np.arange(20_000) + 0.5) / 10_000 - 1.0  # equal shares of a sphere
    everywhere = np.column_stack([np.sqrt(1.0 - height**2), 0.0 * height, height])
    assert Dipole().gain(everywhere).mean() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("path_loss", [Friis(), rays_among(frequency_hz=2.4e9)])
def test_an_antenna_turns_with_its_vehicle(path_loss: Any) -> None:
    """In free space rays and Friis' law agree; a dipole that points at a receiver has a null there."""
    isotropic = levels(path_loss)
    for angle in (0.0, 0.3, 1.0):
        changed = levels(path_loss, attitude=pitched(angle), antenna="dipole") - isotropic
        axis = np.array([math.sin(angle), 0.0, math.cos(angle)])
        to_c = (PLACES[2] - PLACES[0]) / 5.0
        for there, cosine in ((1, axis[0]), (2, float(axis @ to_c))):
            expected = 1.643 * math.cos(0.5 * math.pi * cosine) ** 2 / (1.0 - cosine**2)
            assert changed[0, there] == pytest.approx(10.0 * math.log10(expected), abs=1e-9)
            assert changed[there, 0] == pytest.approx(changed[0, there], abs=1e-9)
        assert changed[1, 2] == 0.0
    assert levels(path_loss, attitude=pitched(0.5 * math.pi), antenna="dipole")[0, 1] < isotropic[0, 1] - 100.0


def test_each_path_leaves_in_its_own_direction() -> None:
    """Two paths over metal; a dipole attenuates the steeper one more, seen from both ends."""
    rays, far = rays_among(ground="metal"), np.array([(0.0, 0.0, 4.0), (6.0, 0.0, 1.0), (300.0, 0.0, 1.0)])
    changed = levels(rays, far, antenna="dipole")[0] - levels(rays, far)[0]
    for column in (1, 2):
        rise = np.array([-3.0, -5.0])
        length = np.hypot(far[column, 0], rise)
        cosine = rise / length
        gain = 1.643 * np.cos(0.5 * np.pi * cosine) ** 2 / (1.0 - cosine**2)
        power = 1.0 / length**2
        assert changed[column] == pytest.approx(10.0 * math.log10((power * gain).sum() / power.sum()), abs=1e-3)


def test_a_pattern_from_a_file(tmp_path: Path) -> None:
    """Exact at its points, linear in dB between them; azimuth 0 is forward, 90 left, and wraps round."""
    rows = [
        f"{elevation},{azimuth},{0.1 * elevation + azimuth / 30}" for elevation in (-90, 0, 60) for azimuth in (0, 90, 180, 270)
    ]
    (tmp_path / "own.csv").write_text(PATTERN + "\n".join(rows), "utf-8")
    at = {(0.0, 0.0): 0.0, (0.0, 90.0): 3.0, (30.0, 45.0): 4.5, (0.0, 315.0): 4.5, (80.0, 0.0): 6.0, (-45.0, 180.0): 1.5}
    turned = np.radians(np.array(list(at)))
    across = np.cos(turned[:, 0])
    direction = np.column_stack([across * np.cos(turned[:, 1]), across * np.sin(turned[:, 1]), np.sin(turned[:, 0])])
    found = read_pattern(str(tmp_path / "own.csv")).gain(direction)
    assert 10.0 * np.log10(found) == pytest.approx(list(at.values()), abs=1e-9)


def test_the_pattern_of_the_page(tmp_path: Path) -> None:
    (tmp_path / "own.csv").write_text(block("docs/explanation/rays.md", "gain_dbi"), "utf-8")
    level = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    assert 10.0 * np.log10(read_pattern(str(tmp_path / "own.csv")).gain(level)) == pytest.approx([1.75, -0.625])


SCENARIO: dict[str, Any] = {
    "name": "antennas",
    "duration_s": 0.3,
    "radio": {"preset": "wifi-b-1"},
    "vehicle": [
        {"name": "one", "kind": "p2dx", "pose": (0.0, 0.0, 0.5 * math.pi), "agent": {"kind": "trajectory", "path": "straight"}},
        {"name": "two", "kind": "p2dx", "pose": (0.0, 9.0, 0.0), "agent": {"kind": "leader_follower", "leader": "one"}},
    ],
}


def test_a_run_with_a_pattern_keeps_its_file(tmp_path: Path) -> None:
    """A beam of 10 dBi forward and -20 dBi elsewhere: the receiver is ahead."""
    (tmp_path / "beam.csv").write_text(PATTERN + "0,-30,-20\n0,0,10\n0,30,-20\n", "utf-8")
    one, two = SCENARIO["vehicle"]
    own = SCENARIO | {"vehicle": [one | {"radio": {"antenna_pattern": str(tmp_path / "beam.csv")}}, two]}
    plain, beam = (vcmvsp.run(each, out=tmp_path / name) for name, each in (("plain", SCENARIO), ("beam", own)))
    difference = beam.radio["rssi_dbm"][0].as_py() - plain.radio["rssi_dbm"][0].as_py()
    assert difference == pytest.approx(10.0, abs=0.1)
    (tmp_path / "beam.csv").unlink()
    again = vcmvsp.run(tmp_path / "beam" / "scenario.toml", out=tmp_path / "again")
    assert again.radio.equals(beam.radio)


@pytest.mark.parametrize(
    ("radio", "text", "words"),
    [
        ({"antenna_pattern": "p.csv", "antenna": "dipole"}, PATTERN + "0,0,1\n", r"one.radio.antenna_pattern: is given beside"),
        ({"antenna_pattern": "p.csv"}, "0,0,1\n", "the first line must be elevation_deg,azimuth_deg,gain_dbi"),
        ({"antenna_pattern": "p.csv"}, PATTERN + "0,0,1\n0,90,1\n10,0,1\n", "3 points are not a grid of 2 elevations x 2"),
        ({"antenna_pattern": "p.csv"}, PATTERN + "0,0,1\n91,0,1\n", r"line 3: 91,0,1 is out of range"),
        ({"antenna_pattern": "p.csv"}, PATTERN + "0,0,x\n", "line 2: must be three numbers"),
        ({"antenna_pattern": "p.csv"}, PATTERN + "0,0,1\n0,360,1\n", "leave the last one out"),
        ({"antenna_pattern": "q.csv"}, "", "there is no such file"),
        ({"antenna": "yagi"}, "", "'isotropic', 'dipole'|isotropic"),
    ],
)
def test_bad_antennas(tmp_path: Path, radio: dict[str, Any], text: str, words: str) -> None:
    (tmp_path / "p.csv").write_text(text, "utf-8")
    if "antenna_pattern" in radio:
        radio = radio | {"antenna_pattern": str(tmp_path / radio["antenna_pattern"])}
    one, two = SCENARIO["vehicle"]
    with pytest.raises(ScenarioError, match=words):
        vcmvsp.run(SCENARIO | {"vehicle": [one | {"radio": radio}, two]}, out=tmp_path / "run")
