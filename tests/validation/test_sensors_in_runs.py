"""Sensors in whole runs: delivery of readings, their cost, and equal readings in any process."""

from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.command_line import contents
from vcmvsp import Agent, Observation, Radio, Scan, Velocity
from vcmvsp.physics.sensors.camera import Camera
from vcmvsp.physics.sensors.range_scanner import RangeScanner

pytestmark = pytest.mark.processes

ROOM: dict[str, Any] = {
    "name": "room",
    "duration_s": 3.0,
    "seed": 4,
    "world": {"kind": "boxes", "boxes": [{"center": [3.0, 0.0, 0.5], "size": [0.2, 6.0, 1.0]}]},
    "radio": {"preset": "wifi-b-1"},
    "vehicles": {
        "kind": "p2dx",
        "sensors": {
            "scan": {"kind": "lms", "sigma_m": 0.01, "drop_out": 0.2},
            "cam": {"kind": "camera", "rate_hz": 5.0, "noise": 3.0, "latency_s": 0.05},
            "imu": {"kind": "imu", "rate_hz": 20.0},
            "gps": {"kind": "gps", "rate_hz": 5.0, "latency_s": 0.1},
        },
    },
    "vehicle": [
        {"name": "a", "agent": {"kind": f"{__name__}:WallApproach", "scanner": "scan"}},
        {"name": "b", "pose": [0.0, 1.5, 0.0], "agent": {"kind": f"{__name__}:WallApproach", "scanner": ""}},
    ],
}


class WallApproach(Agent):
    """Drives at the wall, slower near it; sends its nearest range and yaw rate."""

    def __init__(self, scanner: str = "scan") -> None:
        self.scanner = scanner
        self.sensors = (scanner, "imu") if scanner else ("imu",)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        assert set(obs.readings) <= {"odometry", self.scanner, "imu"}  # no other sensors
        scan = obs.readings.get(self.scanner)
        nearest = float(scan.ranges.min()) if isinstance(scan, Scan) else 1.0
        imu = obs.readings.get("imu")
        radio.send(nearest=nearest, turning=0.0 if imu is None else imu.angular_velocity[2])  # type: ignore[union-attr]
        return Velocity(linear=(min(0.5, 0.2 * nearest), 0.0, 0.0))


def test_equal_bytes_with_sensors_in_any_process(tmp_path: Path) -> None:
    recorded = {**ROOM, "record": {"sensors": ["scan", "cam"]}}
    here = contents(vcmvsp.run(recorded, out=tmp_path / "here").folder or tmp_path)
    away = contents(vcmvsp.run(recorded, agents="process", out=tmp_path / "away").folder or tmp_path)
    assert [name for name in here if here[name] != away[name]] == []
    again = vcmvsp.run(tmp_path / "here" / "scenario.toml", out=tmp_path / "again")
    assert contents(tmp_path / "again")["metrics.json"] == here["metrics.json"]
    assert again.metrics["radio"]["frames"] > 0


def test_unused_pictures_and_scans_are_never_made(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    measure = RangeScanner.measure_all.__func__  # type: ignore[attr-defined]

    def counted(cls: type, sensors: Any, *rest: Any) -> Any:
        looked.extend(sensors)
        return measure(cls, sensors, *rest)

    def never(*_: Any) -> Any:
        raise AssertionError("nobody looks at this camera")

    monkeypatch.setattr(RangeScanner, "measure_all", classmethod(counted))
    monkeypatch.setattr(Camera, "measure", never)
    alone = vcmvsp.run(ROOM)
    assert 20 <= len(looked) <= 30  # of vehicle a only: ten a second, a fifth of them dropped
    looked.clear()
    everybody = vcmvsp.run({**ROOM, "record": {"sensors": ["scan"]}})
    assert len(looked) > 40
    assert everybody.states.equals(alone.states)  # recording changes nothing


def test_readings_do_not_depend_on_sensors_of_other_vehicles() -> None:
    def heard(vehicles: list[dict[str, Any]]) -> list[Any]:
        result = vcmvsp.run({**ROOM, "vehicle": vehicles})
        return result.states.filter(result.states["vehicle"].to_numpy() == "a")["x"].to_pylist()

    a, b = ROOM["vehicle"]
    bare = {**b, "pose": [0.0, -50.0, 0.0], "sensors": {}, "agent": {"kind": f"{__name__}:WallApproach", "scanner": ""}}
    assert heard([a, bare]) == heard([a, {**bare, "sensors": ROOM["vehicles"]["sensors"]}])


@pytest.mark.parametrize(
    ("sensors", "key", "words"),
    [
        ({"scan": {"kind": "lms", "rate_hz": 500.0}}, "vehicle.a.sensors.scan.rate_hz", "120"),
        ({"scan": {"kind": "lms", "beans": 5}}, "vehicle.a.sensors.scan.beans", "did you mean 'beams'?"),
        ({"scan": {"kind": "lmz"}}, "vehicle.a.sensors.scan.kind", "did you mean 'lms'?"),
        ({"scan": {}}, "vehicle.a.sensors.scan.kind", "must be a string"),
        ({"cam": {"kind": "camera", "width": 0}}, "vehicle.a.sensors.cam.width", ""),
        ({"gps": {"kind": "gps", "drop_out": 1.5}}, "vehicle.a.sensors.gps.drop_out", "<= 1"),
        ({"imu": {"kind": "imu", "latency_s": -1.0}}, "vehicle.a.sensors.imu.latency_s", ">= 0"),
        ({"heard": {"kind": "imu"}}, "vehicle.a.sensors.heard", "'heard' is not a valid sensor name"),
        ({"map": {"kind": "imu"}}, "vehicle.a.sensors.map", "'map' is not a valid sensor name"),  # a topic of agents
    ],
)
def test_bad_sensors_are_refused_by_name(sensors: Any, key: str, words: str) -> None:
    with pytest.raises(vcmvsp.ScenarioError) as raised:
        vcmvsp.run({**ROOM, "vehicles": {"kind": "p2dx"}, "vehicle": [{"name": "a", "sensors": sensors}]})
    assert raised.value.key == key
    assert words in str(raised.value)


def test_a_vehicle_below_or_outside_the_world_is_refused() -> None:
    for world, position in (({"kind": "laboratory"}, [50.0, 0.0, 0.0]), ({"kind": "urban"}, [0.0, 500.0, 5.0])):
        with pytest.raises(vcmvsp.ScenarioError, match="outside") as raised:
            vcmvsp.run({**ROOM, "world": world, "vehicle": [{"name": "a", "position": position}]})
        assert raised.value.key == "vehicle.a.position"
