"""Real vehicles in a run: content and times of orders, ends of a run, and a run with a simulated robot from end to end."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import vcmvsp
from tests.support.hardware.stations import FakeStation, real_vehicle
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.clock import SECOND_NS, Ticks, WallClock
from vcmvsp.cosim.errors import FederateError, Interrupted, ScenarioError, UsageError
from vcmvsp.cosim.export.formats import export
from vcmvsp.cosim.federate import Event, Instants, Log, RunInfo
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.scenario.schema import RealVehicle, SafetyTable
from vcmvsp.cosim.terminal.progress import summary
from vcmvsp.cosim.types import Incident, RealStatus, States, VehicleState, Velocity, frozen
from vcmvsp.hardware.drivers.base import Notice
from vcmvsp.hardware.federate import HEARTBEAT, Hardware
from vcmvsp.hardware.station.messages import KNOWN_S, OPERATOR_STOP, StationReport
from vcmvsp.hardware.stations import StationError, mission

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

TENTH = SECOND_NS // 10
SAFETY = msgspec.convert(
    {"max_speed": 1.0, "max_yaw_rate": 1.0, "accel": 0.5, "decel": 0.5, "yaw_accel": 1.0, "radius_m": 0.2}, SafetyTable
)


def vehicle(**changes: Any) -> RealVehicle:
    return real_vehicle(**{"safety": SAFETY, **changes})


def federate(
    *, period_ns: int = TENTH, log: Log = lambda *_: None, radius_m: float = 0.3, **changes: Any
) -> tuple[Hardware, FakeStation]:
    """A federate connected to a fake station, at time 0."""
    station, radii_m, ticks = FakeStation(), {"car2": radius_m}, Instants(Ticks(period_ns))
    vehicles = (vehicle(**changes),)
    made = Hardware(vehicles, run="test", clock=WallClock(), radius_m=radii_m, tell=lambda _: None, log=log, connect=False)
    info = RunInfo(scenario="test", seed=0, duration_ns=10 * SECOND_NS, vehicles=("car1", "car2"), instants=(ticks,))
    made.start(info)
    made._connect = True
    made._proxies["car1"].station = station  # type: ignore[assignment]
    made._clock.start()
    return made, station


def hardware_of(content: dict[str, Any]) -> Hardware:
    """The federate of a scenario."""
    with assemble(*loader.load(content)) as assembled:
        (made,) = [each for each in assembled.federates if isinstance(each, Hardware)]
    return made


def world(time_ns: int, x: float, v: float) -> Event:
    """States with car2 at x and speed v along the x axis; car1 stands at the origin."""
    zero = frozen(np.zeros((2, 3)))
    states = States(
        names=("car1", "car2"),
        position=frozen([[0.0, 0.0, 0.0], [x, 0.0, 0.0]]),
        velocity=frozen([[0.0, 0.0, 0.0], [v, 0.0, 0.0]]),
        attitude=frozen([[1.0, 0.0, 0.0, 0.0]] * 2),
        angular_velocity=zero,
    )
    return Event("world/states", time_ns, states)


def report(number: int = 1, **more: Any) -> StationReport:
    return StationReport(number=number, time_ns=time.monotonic_ns(), state=VehicleState(position=(0.0, 0.0, 0.0)), **more)


def test_orders_are_repeated_at_heartbeats_and_commands() -> None:
    made, station = federate(period_ns=SECOND_NS)
    step = made.step(0, ())
    times = [0]
    while step.next_ns is not None and step.next_ns < SECOND_NS:
        times.append(step.next_ns)
        step = made.step(step.next_ns, ())
    assert times == [HEARTBEAT.at(k) for k in range(20)]
    assert [order.number for order in station.orders] == list(range(1, 21))
    made.step(times[-1], [Event("car1/command", times[-1], Velocity(linear=(0.1, 0.0, 0.0)))])
    assert station.orders[-1].command == Velocity(linear=(0.1, 0.0, 0.0))


def test_a_station_gets_current_positions_of_others() -> None:
    made, station = federate()
    seen_ns = made._clock.logical_ns(time.monotonic_ns()) - SECOND_NS // 2
    made.step(0, [world(seen_ns, x=2.0, v=-1.0)])
    longest_s = (made._clock.logical_ns(time.monotonic_ns()) - seen_ns) / SECOND_NS
    others: Any = station.orders[-1].others
    ((x, y, z, vx, vy, vz, radius),) = others.tolist()
    assert 2.0 - min(longest_s, KNOWN_S) - 1e-6 <= x <= 1.5 + 1e-6  # extrapolated by 0.5 s plus the duration of this test
    assert (y, z, vx, vy, vz, radius) == (0.0, 0.0, -1.0, 0.0, 0.0, 0.3)
    made.step(TENTH, [world(seen_ns - 100 * SECOND_NS, x=2.0, v=-1.0)])
    others = station.orders[-1].others
    assert others[0, 0] == pytest.approx(2.0 - KNOWN_S)


@pytest.mark.parametrize("radius_m", [0.0, math.nan, math.inf])
def test_others_without_a_radius_are_refused(radius_m: float) -> None:
    with pytest.raises(ScenarioError, match=r"vehicle\.car2\.kind: car2 has a radius of .*, so real vehicles cannot avoid it"):
        federate(radius_m=radius_m)


def test_robots_keep_away_from_the_circle_around_the_body_of_another() -> None:
    two = scenario(vehicle=[BENCH["vehicle"][0], {"name": "car2", "kind": "p2dx", "pose": [3.0, 0.0, 0.0]}])
    robots = hardware_of(two)
    half_length_m, half_width_m = 0.5 * 0.511 + 0.04, 0.5 * 0.425  # the axle is ahead of the centre
    assert robots._radius_m["car2"] == pytest.approx(math.hypot(half_length_m, half_width_m))


def test_events_come_only_at_instants_and_are_logged() -> None:
    logged: list[tuple[str, int]] = []
    made, station = federate(log=lambda key, time_ns, _: logged.append((key, time_ns)))
    station.saying = [report()]
    keys = [event.key for event in made.step(0, ()).events]
    assert keys == ["car1/estimate", "car1/real"]
    assert made.step(TENTH // 2, ()).events == []
    assert made.step(0, ()).events == []  # called for a command of the same instant
    made.states(0)
    assert logged == [("car1/estimate", 0), ("car1/real", 0), ("car1/reflected", 0)]


def test_an_operator_stop_between_instants_is_recorded_and_ends_the_run() -> None:
    made, station = federate(period_ns=SECOND_NS)
    made.step(0, ())
    stopped = Notice(time_ns=time.monotonic_ns(), what="stopped", cause=OPERATOR_STOP)
    station.saying = [report(notices=(stopped,), causes=(OPERATOR_STOP,))]
    (event,) = made.step(TENTH // 2, ()).events
    incident: Any = event.value
    assert (event.key, incident.cause) == ("car1/incident", OPERATOR_STOP)
    with pytest.raises(Interrupted, match="car1 stands: operator's stop"):
        made.step(TENTH, ())


def test_the_last_report_is_recorded_before_a_failure_ends_the_run() -> None:
    made, station = federate(period_ns=SECOND_NS)
    made.step(0, ())
    lost = Notice(time_ns=time.monotonic_ns(), what="lost", cause="unplugged")
    station.saying, station.failing = [report(notices=(lost,))], StationError("car1", "unplugged", "plug it in")
    assert made.step(TENTH // 2, ()).events == []
    (incident,) = [event.value for event in made.step(TENTH, ()).events]
    assert incident == Incident(what="lost", cause="unplugged", happened_ns=made._clock.logical_ns(lost.time_ns))
    with pytest.raises(StationError, match="unplugged; plug it in"):
        made.step(3 * TENTH // 2, ())


@pytest.mark.parametrize("on_lost", ["hold", "remove"])
def test_a_run_may_continue_without_a_lost_robot(on_lost: str) -> None:
    logged: list[tuple[str, object]] = []
    made, station = federate(on_lost=on_lost, log=lambda key, _, value: logged.append((key, value)))
    moving = VehicleState(position=(1.0, 2.0, 0.0), velocity=(0.4, 0.0, 0.0))
    station.saying = [StationReport(number=1, time_ns=time.monotonic_ns(), state=moving)]
    made.step(0, ())
    station.failing = StationError("car1", "unplugged", "plug it in")
    events = {event.key: event.value for event in made.step(TENTH, ()).events}
    incident: Any = events["car1/incident"]
    assert (incident.what, "unplugged; plug it in" in incident.cause) == ("lost", True)
    assert ("operator/outage" in events) == ("car1/follows" in events) == (on_lost == "remove")
    assert ("car1/outage" in dict(logged)) == (on_lost == "remove")  # a replay repeats it
    order_count = len(station.orders)
    event = Event("car1/command", 2 * TENTH, Velocity(linear=(0.4, 0.0, 0.0)))
    later = [made.step(k * TENTH, [event] if k == 2 else ()).events for k in range(2, 9)]
    status: Any = next(each.value for each in later[-1] if each.key == "car1/real")
    assert status.causes == ("its robot is lost",)
    assert len(station.orders) == order_count  # no further orders
    made._clock._origin -= 3 * SECOND_NS  # 3 s later
    places = {state.position for k in range(40, 60) for state in made.states(k * TENTH)}
    assert len(places) == 1
    assert 1.0 <= places.pop()[0] <= 1.0 + 0.4 * 0.6
    made.release()


def test_a_lost_robot_has_the_policy_of_its_agent() -> None:
    own = {**BENCH["vehicle"][0], "agent": {**BENCH["vehicle"][0]["agent"], "on_lost": "remove"}}
    held, removed = scenario(agents={"on_lost": "hold"}), scenario(vehicle=[own])
    for content, policy in ((held, "hold"), (removed, "remove"), (BENCH, "stop")):
        assert hardware_of(content)._proxies["car1"].vehicle.on_lost == policy


def test_a_station_silent_during_listening_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [time.monotonic_ns()]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    made, station = federate(period_ns=SECOND_NS)
    station.saying = [report()]
    for step in range(20):
        made.step(step * TENTH // 2, ())
        now_ns[0] += TENTH // 2
    now_ns[0] += 5 * SECOND_NS  # a delay of the run itself does not count
    made.step(SECOND_NS, ())
    for step in range(21, 60):
        if made._proxies["car1"].over is not None:
            break
        now_ns[0] += TENTH // 2
        made.step(step * TENTH // 2, ())
    assert step == pytest.approx(41, abs=2)
    with pytest.raises(FederateError, match="no message of its station for 1 s: the station hangs"):
        made.step(60 * TENTH, ())


def test_a_robot_gets_a_stop_before_any_close() -> None:
    made, station = federate()
    made.release()
    assert station.orders[-1].stop == "the run is over"


def test_a_mission_has_all_of_safety_and_waits_for_slow_agents() -> None:
    fence = ((-1.0, -1.0), (1.0, -1.0), (0.0, 2.0))
    station_mission = mission(vehicle(safety=msgspec.structs.replace(SAFETY, fence=fence, max_speed=0.3)), "run", 1.0)
    assert (station_mission.safety.fence, station_mission.safety.max_speed, station_mission.safety.command_s) == (
        fence,
        0.3,
        2.5,
    )
    assert mission(vehicle(), "run", 0.1).safety.command_s == 0.5
    assert mission(vehicle(safety=msgspec.structs.replace(SAFETY, command_s=0.7)), "run", 1.0).safety.command_s == 0.7


# --- whole runs ---------------------------------------------------------------------------------------------------------------

BENCH: dict[str, Any] = {
    "name": "real",
    "duration_s": 2.0,
    "physics": {"kind": "kinematic"},
    "safety": {"command_s": 5.0, "federation_s": 5.0},  # long enough for a loaded machine
    "vehicle": [
        {
            "name": "car1",
            "kind": "kinematic",
            "driver": {"kind": "bench", "latency_s": 0.02, "command_timeout_s": 2.0},
            "agent": {"kind": "trajectory", "path": "straight", "speed": 0.3},
        },
        {"name": "car2", "kind": "kinematic", "pose": [0.0, 2.0, 0.0]},
    ],
}


def at(name: str, port: str) -> dict[str, Any]:
    return {"name": name, "kind": "amigobot", "driver": {"kind": "arcos", "port": port}}


def scenario(**changes: Any) -> dict[str, Any]:
    return {**BENCH, **changes}


def held_up_s(result: vcmvsp.Result, name: str) -> float:
    """Delay of the run and the station on this machine, s; 0.0 without delays.

    Nothing else stops a robot here: it stands if its station was delayed by half a second.
    """
    real = result.metrics["hardware"][name]
    held_s: float = result.about["lateness"]["slipped_s"] + max(0.0, real["age_s"]["max"] - 0.3)
    causes = ("the station was delayed, or its clock jumped", "no command for ")  # the latter if it stood for seconds
    assert all(each.startswith(causes) for each in real["stops"]) if held_s > 0.1 else real["stops"] == {}
    return held_s


def test_a_real_vehicle_drives_to_its_place(tmp_path: Path) -> None:
    result = vcmvsp.run(scenario(), out=tmp_path / "run")
    x = result.states.to_pandas().query("vehicle == 'car1'")["x"].to_numpy()
    assert x[-1] == pytest.approx(0.3 * 2.0, abs=0.25 + 0.3 * held_up_s(result, "car1"))  # minus acceleration
    assert (np.diff(x) > -0.01).all()
    real = result.metrics["hardware"]["car1"]
    assert 0.02 <= real["age_s"]["p50"] < 1.0
    late = result.about["lateness"]
    assert late["instants"] == 20
    again = vcmvsp.run(tmp_path / "run" / "scenario.toml", playback=tmp_path / "run")
    assert again.metrics == result.metrics


def test_a_fence_holds_in_a_run_and_outputs_name_the_limiting_laws(tmp_path: Path) -> None:
    fence = [[-1.0, -1.0], [0.6, -1.0], [0.6, 1.0], [-1.0, 1.0]]
    own = {**BENCH["vehicle"][0], "safety": {"fence": fence, "fence_margin_m": 0.05}}
    result = vcmvsp.run(scenario(duration_s=2.5, vehicle=[own]), out=tmp_path / "run")
    farthest = 0.6 - 0.25 - 0.05 + 0.01  # minus radius and margin
    assert result.states.to_pandas()["x"].max() < farthest + 0.3 * held_up_s(result, "car1")
    real = result.metrics["hardware"]["car1"]
    assert real["limited_s"] > 0.5
    assert real["limited_by_s"]["geofence"] > 0.5
    assert real["limited_by_s"]["limits"] > 0.5  # during acceleration
    assert sum(real["limited_by_s"].values()) > real["limited_s"] - 1e-9  # several may act at once
    phrase = f"the fence {real['limited_by_s']['geofence']:.1f} s"
    assert phrase in summary(result)
    (tables,) = export(tmp_path / "run", csv=tmp_path / "csv")
    assert phrase in (tmp_path / "run/report.html").read_text()
    with (tables / "real.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {"geofence", "limits"} <= {cause for each in rows for cause in each["causes"].split("; ")}
    assert abs(float(rows[-1]["sent_vx_m_s"])) < 0.3
    with (tables / "incidents.csv").open() as stream:
        assert next(iter(csv.DictReader(stream)))["what"] == "connected"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"safety": {"fence": [[0.0, 0.0], [1.0, 1.0]]}}, "safety: a fence needs at least three corners"),
        ({"safety": {"fence": [[2.0, 2.0], [3.0, 2.0], [3.0, 3.0]]}}, "safety: car1 starts outside the fence"),
        ({"safety": {"max_speed": -1.0}}, "safety.max_speed: must be a number > 0"),
        (
            {"vehicle": [{**BENCH["vehicle"][0], "kind": "quadrotor"}]},
            "driver.kind: is for robots on the ground, but car1 flies",
        ),
        ({"vehicle": [at("car1", "/dev/x"), at("car2", "/dev/x")]}, "car2.driver.port: '/dev/x' is also used by car1"),
        ({"clock": {"late": "never"}}, "clock.late: must be one of 'slip', 'stop'"),
    ],
)
def test_errors_are_found_before_any_connection(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ScenarioError, match=says):
        api.check(scenario(**changes))


@pytest.mark.parametrize("key", ["localisation", "safety", "fusion"])
def test_real_vehicle_tables_need_a_real_vehicle(key: str) -> None:
    tables = {"localisation": {"kind": "ubisense"}, "safety": {"max_speed": 1.0}, "fusion": {"gate": 0.9}}
    plain = {"name": "car1", "kind": "kinematic", key: tables[key]}
    with pytest.raises(ScenarioError, match=f"vehicle.car1.{key}: is only for real vehicles"):
        api.check(scenario(vehicle=[plain]))
    api.check(scenario(vehicle=[{**BENCH["vehicle"][0], "driver": {"kind": "none"}, key: tables[key]}]))


def test_real_vehicles_keep_to_the_wall_clock() -> None:
    with pytest.raises(UsageError, match="--realtime 2: real vehicles \\(car1\\) need speed 1"):
        vcmvsp.run(scenario(), realtime=2.0)
    begin = time.monotonic()
    vcmvsp.run(scenario(duration_s=0.5))
    assert time.monotonic() - begin > 0.5


SLOW = """
import time
from vcmvsp import Agent
class Slow(Agent):
    def act(self, obs, radio):
        time.sleep(0.0 if obs.time_ns else 0.25)
"""


@pytest.mark.parametrize("late", ["slip", "stop"])
def test_a_late_run_slips_or_stops_as_configured(tmp_path: Path, late: str) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    agent = {"kind": f"{tmp_path}/slow.py:Slow"}
    plain = scenario(duration_s=0.5, clock={"late": late}, vehicle=[{"name": "car1", "kind": "kinematic", "agent": agent}])
    if late == "stop":
        with pytest.raises(FederateError, match=r"clock: 0\.0\d* s began \d+\.\d+ s late, more than clock.tolerance_s"):
            vcmvsp.run(plain, realtime=1.0)
        return
    slept = vcmvsp.run(plain, realtime=1.0).about["lateness"]
    assert slept["over_one_period"] >= 1
    assert slept["slipped_s"] > 0.1


def test_a_killed_run_leaves_a_replayable_recording(tmp_path: Path) -> None:
    (tmp_path / "s.json").write_text(json.dumps(scenario(duration_s=60.0)))
    program = f"import vcmvsp, json; vcmvsp.run(json.load(open('{tmp_path}/s.json')), out='{tmp_path}/run')"
    child = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path)
    try:
        recording = tmp_path / "run" / "hardware.mcap"
        until = time.monotonic() + 60.0
        while not (recording.exists() and recording.stat().st_size > 4000) and time.monotonic() < until:
            time.sleep(0.05)
        os.kill(child.pid, signal.SIGKILL)
    finally:
        child.kill()
        child.wait(10)
    again = vcmvsp.run(tmp_path / "run" / "scenario.toml", playback=tmp_path / "run", set={"duration_s": 1.0})
    assert again.states.to_pandas().query("vehicle == 'car1'")["x"].max() > 0.05


def test_an_emulated_robot_drives_in_formation_behind_a_real_port(tmp_path: Path) -> None:
    result = vcmvsp.run(
        "hybrid-formation",
        set={
            "duration_s": 4.0,
            "metrics.from_s": 2.5,
            "vehicle.car3.localisation.listen": "udp://127.0.0.1:0",
            "vehicle.car3.driver.command_timeout_s": 2.0,
            "vehicle.car3.driver.silence_s": 20.0,
            **{f"safety.{key}": seconds for key, seconds in BENCH["safety"].items()},
        },
        out=tmp_path / "run",
    )
    real = result.metrics["hardware"]["car3"]
    assert real["fixes"] > 5
    states = result.states.to_pandas().query("vehicle == 'car3'")
    assert states["x"].iloc[-1] - states["x"].iloc[0] > 0.3
    assert result.metrics["formation"]["rms_m"] < 0.3 + 0.3 * held_up_s(result, "car3")


def status(t: float, **more: Any) -> tuple[int, RealStatus]:
    return round(t * SECOND_NS), RealStatus(link=more.pop("link", 1), age_s=more.pop("age_s", 0.1), **more)


def test_metrics_of_a_real_vehicle_by_hand() -> None:
    from vcmvsp.cosim.metrics.agents import hardware_metrics
    from vcmvsp.cosim.metrics.radio import ReceptionRows

    got = ReceptionRows(
        receivers=("car2",),
        senders=("car1",),
        to=np.zeros(3, int),
        by=np.zeros(3, int),
        sent_ns=np.array([0, 0, 0]),
        received_ns=np.array([1, 5, 20]) * SECOND_NS // 100,
    )
    statuses = [
        status(0.0, causes=("limits",)),
        status(0.5, gated=1),
        status(1.0, link=3, causes=("limits", "geofence"), gated=2),
        status(3.0, causes=("geofence", "separation")),
        status(4.0),
    ]
    stopped = [("car1", Incident(what="stopped", cause="no command", happened_ns=0))] * 2
    found = hardware_metrics({"car1": statuses}, stopped, {"car1": 7}, [got])["car1"]
    assert found["age_s"] == {"p50": 0.1, "p99": 0.1, "max": 0.1}
    assert (found["fixes"], found["gated"], found["reconnects"]) == (7, 2, 2)
    assert found["stops"] == {"no command": 2}
    assert found["limited_s"] == 3.5
    assert found["limited_by_s"] == {"geofence": 3.0, "limits": 0.5, "separation": 1.0}  # limits may act beside the fence
    assert found["frames_too_early"] == 2
