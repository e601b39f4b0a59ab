"""``vcmvsp calibrate-recognition``: pictures with known targets, counts of looks, and the command's output."""

import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.analysis.snapshots import InSight, Rates, Share, Snapshot, Snapshots
from vcmvsp.cosim.types import Sighting

FLAG = {"name": "flag", "picture": "targets/alpha.png", "size_m": 2.0}


def flags(place: tuple[float, float] = (5.0, 3.0), **world: Any) -> dict[str, Any]:
    """A target in an empty square of 60 m, a vehicle above it that searches for it, and another that searches for nothing."""
    camera = {"kind": "nadir_camera", "width": 320, "height": 240, "field_of_view": 1.35}
    target = {"name": "flag", "picture": "targets/alpha.png", "size": 2.0, "place": place}
    uav = {"kind": "quadrotor", "position": [0.0, 0.0, 15.0]}
    return {
        "name": "flags",
        "duration_s": 10.0,
        "world": {"kind": "boxes", "bounds": [-30.0, -30.0, 30.0, 30.0], "boxes": [], "targets": [target], **world},
        "vehicle": [
            {**uav, "name": "blind"},
            {**uav, "name": "uav1", "sensors": {"camera": camera}, "agent": {"kind": "track", "watching": {"targets": [FLAG]}}},
        ],
    }


def box(x: float, y: float, size: float, height: float) -> dict[str, Any]:
    return {"center": [x, y, 0.5 * height], "size": [size, size, height], "color": [90, 90, 90]}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "flags.toml"
    path.write_text(tomli_w.dumps(flags()))
    return path


# --- pictures ---


def test_sightings_have_the_place_and_angle_of_the_target() -> None:
    snapshots = Snapshots(flags())
    pictures = [snapshots.take(number, 12) for number in range(12)]
    assert all(len(each.targets) == 1 for each in pictures[::2])
    both = [(each.targets[0], each.sightings[0]) for each in pictures if each.targets and each.sightings]
    assert len(both) >= 4
    for target, sighting in both:
        assert sighting.target == target.name == "flag"
        assert sighting.centre_px == pytest.approx(target.pixel, abs=0.5)
        assert sighting.place == pytest.approx((5.0, 3.0), abs=0.1)
        assert abs(math.remainder(sighting.angle - target.angle, math.tau)) < math.radians(3.0)
        assert target.visible == 1.0


def test_hits_are_the_map_cells_with_targets() -> None:
    """Cells of 2 m from the south-west corner of the area, (-30, -30): the target is in column 17, row 16, of 30 columns."""
    snapshots = Snapshots(flags())
    hit = [each.cells[each.hits].tolist() for each in (snapshots.take(number, 12) for number in range(12)) if each.sightings]
    assert {tuple(cells) for cells in hit} == {(16 * 30 + 17,)}


def test_half_a_target_under_a_roof_is_half_visible() -> None:
    """A roof on its eastern half, 0.5 m high, is displaced by 0.3 m in an oblique view; a roof on all of it covers all."""
    half = Snapshots(flags((0.0, 0.0), boxes=[box(1.5, 0.0, 3.0, 0.5)]))
    shares = [half.take(number, 12).targets[0].visible for number in range(0, 12, 2)]
    assert all(0.2 <= share <= 0.8 for share in shares)
    all_of_it = Snapshots(flags((0.0, 0.0), boxes=[box(0.0, 0.0, 4.0, 0.5)]))
    for number in range(0, 12, 2):
        covered = all_of_it.take(number, 12)
        assert covered.targets[0].visible == 0.0
        assert covered.sightings == ()


def test_vehicles_keep_out_of_buildings() -> None:
    """At least 0.5 m away from walls; the buildings are higher than the flight height."""
    snapshots = Snapshots(flags(boxes=[box(-15.0, -15.0, 20.0, 30.0), box(15.0, 15.0, 20.0, 30.0)]))
    places = np.array([snapshots._placed(np.random.default_rng(i), 0.0, with_target=i % 2 == 0).position for i in range(100)])
    for middle in (-15.0, 15.0):
        assert np.abs(places[:, :2] - middle).max(axis=1).min() > 10.0 + 0.5
    assert np.ptp(places[:, 0]) > 40.0


def test_the_same_seed_gives_the_same_pictures() -> None:
    first, again, other = (Snapshots(flags(), seed=seed).take(2, 10).pixels for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


# --- counts ---


def test_wilsons_interval() -> None:
    """0 of 10 and 81 of 263 (Newcombe, Statistics in Medicine 17, 1998, table I, method 3: 0.2553 to 0.3662)."""
    assert Share(0, 10).interval == pytest.approx((0.0, 0.2775), abs=5e-5)
    assert Share(81, 263).interval == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert Share(0, 0).interval == (0.0, 1.0)
    assert math.isnan(Share(0, 0).value)
    assert (Share(0, 8).mean, Share(8, 8).mean) == (0.1, 0.9)


def picture(places: list[tuple[float, float]], **target: Any) -> Snapshot:
    """Cells 0 to 9: a target at the origin is in cell 3; sightings within 1 m of it hit cell 3, others cell 7."""
    known = InSight("flag", (0.0, 0.0), 2.0, (50.0, 50.0), 0.0, 1.0, True, 3)._replace(**target)
    sightings = tuple(
        Sighting(target="flag", place=place, centre_px=(50.0, 50.0), angle=0.1, side_px=9.0, score=1.0) for place in places
    )
    cells = np.arange(10)
    hits = (cells == 3) & any(math.hypot(*place) < 1.0 for place in places)
    hits |= (cells == 7) & any(math.hypot(*place) >= 1.0 for place in places)
    return Snapshot(np.zeros((101, 101, 3), np.uint8), (known,), sightings, cells, hits)


def test_looks_and_targets_are_counted() -> None:
    rates = Rates()
    rates.add(picture([(0.5, 0.5)]))  # recognised
    rates.add(picture([(9.0, 0.0)]))  # missed, and a false sighting
    rates.add(picture([], visible=0.5))  # missed, half hidden
    rates.add(picture([], looked=False, cell=None))  # not looked at
    assert rates.p == (1, 3)
    assert rates.q == (1, 37)
    assert rates.precision == (1, 2)
    assert rates.recall == (1, 3)
    assert rates.unoccluded == (1, 2)
    assert rates.by_ring["middle third"] == (1, 2)
    assert rates.angles == pytest.approx([0.1])
    assert rates.places == pytest.approx([math.hypot(0.5, 0.5)])
    rates.add(picture([], pixel=(100.0, 100.0)))
    assert rates.by_ring["outer third"] == (0, 1)


# --- the command ---


def test_the_last_lines_are_tables_of_a_scenario(file: Path) -> None:
    outcome = vcmvsp_command("calibrate-recognition", str(file), "--frames", "12", "--quiet")
    assert outcome.code == 0, outcome.err
    assert "12 pictures from 15 m, cells of 2 m" in outcome.out
    lines: Mapping[str, Any] = tomllib.loads(outcome.out[outcome.out.index("[agents]") :])["agents"]
    assert 0.0 < lines["q"] < 0.01 < 0.7 < lines["p"] < 1.0
    assert outcome.err == ""
    assert vcmvsp_command("calibrate-recognition", str(file), "--frames", "12", "--quiet").out == outcome.out


def test_json(file: Path) -> None:
    outcome = vcmvsp_command(
        "calibrate-recognition", str(file), "--frames", "6", "--json", "--height", "12", "--cell", "3", "--quiet"
    )
    answer = json.loads(outcome.out)
    assert (answer["vehicle"], answer["height_m"], answer["cell_m"], answer["frames"]) == ("uav1", 12.0, 3.0, 6)
    assert answer["p"]["of"] == answer["recall"]["of"] >= 2
    assert answer["p"]["value"] == (answer["p"]["count"] + 1) / (answer["p"]["of"] + 2)
    assert set(answer["by_ring"]) == {"middle third", "second third", "outer third"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--frames", "0"), "--frames 0: must be 1 or more"),
        (("--height", "-1"), "--height -1.0: must be a number greater than 0"),
        (("--cell", "nan"), "--cell nan: must be a number greater than 0"),
        (("--seed", "-1"), "--seed -1: must be 0 or more"),
        (("--vehicle", "uav2"), "did you mean 'uav1'?"),
        (("--vehicle", "blind"), "vehicle.blind.agent.watching: is missing: set the camera"),
        (("--set", "vehicle.uav1.agent.watching.camera=eye"), "vehicle.uav1.agent.watching.camera: unknown sensor 'eye'"),
        (("--set", "vehicle.uav1.agent.watching.targets=[]"), "watching.targets: at least one target is needed"),
        (("--set", "world.targets=[]"), "world.targets: no target of uav1 (flag) is in this world"),
        (("--set", "vehicle.uav1.sensors.camera.kind=gps"), "vehicle.uav1.sensors.camera.kind: must be a camera"),
        (("--set", "vehicle.uav1.position=[0.0, 0.0, 0.0]"), "uav1 starts on the ground"),
        (("--height", "0.01"), "the camera of uav1, at 0.01 m, is not above the ground, at 0 m"),
        (("--set", "vehicle.uav1.agent.watching.ground_m=99"), "at 15 m, is not above the ground, at 99 m"),
        (("--set", "vehicle.uav1.agent.height=x"), "agents.height: must be a number, not 'x'"),
        (("--set", "vehicle.uav1.agent.cell_m=0"), "agents.cell_m: must be a number > 0, not 0"),
        (("--cell", "1e-5"), "1e-05 m gives more than 10000000 cells in the area"),
        (("--set", "vehicle.uav1.agent.area=[0,1,2]"), "agents.area: must be a list of 4 values, each a number"),
        (
            ("--set", "vehicle.uav1.agent.area=[9,0,1,2]"),
            "agents.area: must be left, bottom, right, top, not [9.0, 0.0, 1.0, 2.0]",
        ),
        (("--set", "world.boxes=[{center=[0,0,10], size=[90,90,20]}]"), "over the area at 15 m"),
    ],
)
def test_errors_are_reported_with_their_key(file: Path, arguments: tuple[str, ...], words: str) -> None:
    outcome = vcmvsp_command("calibrate-recognition", str(file), "--quiet", *arguments)
    assert outcome.code == 2, outcome.err
    assert words in outcome.err
    assert outcome.out == ""


def test_a_camera_that_sees_the_horizon_can_be_measured() -> None:
    """Tilted by up to 5 deg, the corners of a picture of 173 deg are above the horizon: no target is placed there."""
    scenario = flags()
    scenario["vehicle"][1]["sensors"]["camera"]["field_of_view"] = 3.02
    snapshots = Snapshots(scenario)
    assert all(snapshots.take(number, 6).targets for number in (0, 2, 4))


def test_a_scenario_without_recognition_is_refused() -> None:
    outcome = vcmvsp_command("calibrate-recognition", "lab-patrol")
    assert outcome.code == 2
    assert "lab-patrol: agents.watching: is missing" in outcome.err
