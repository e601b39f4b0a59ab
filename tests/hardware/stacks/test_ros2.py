"""ROS 2 nodes drive simulated vehicles: nodes of zenoh-ros2-sdk, messages decoded by rosbags."""

import contextlib
import json
import math
import subprocess
import threading
from pathlib import Path
from typing import IO, Any

import pytest
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import vcmvsp
from tests.support.hardware.driver_runs import module_process
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.recording.mcap_reader import messages
from vcmvsp.cosim.recording.ros_messages import OWN_TYPES
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.cosim.runs.result import Result
from vcmvsp.cosim.types import VehicleState
from vcmvsp.hardware.drivers.ros2.node import Node
from vcmvsp.hardware.drivers.ros2.protocol import TWIST, Endpoint, RmwZenoh, Twist, encode_twist

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

GOALS = {"car1": (2.0, 1.0), "car2": (-2.0, 1.0)}
STRING = "std_msgs/msg/String"


def node(port: int, vehicle: str, *options: str) -> contextlib.AbstractContextManager["subprocess.Popen[str]"]:
    """A node in a process of its own that connects as soon as the run listens."""
    return module_process("ros2_node", port, vehicle, *GOALS[vehicle], *options)


def scenario(port: int, *vehicles: str, duration_s: float = 8.0, **more: Any) -> dict[str, Any]:
    sensors = {"scan": {"kind": "lms", "rate_hz": 10.0}, "inertia": {"kind": "imu", "rate_hz": 30.0}}
    stack = {"vehicles": list(vehicles), "pace": "lockstep", "endpoint": f"tcp/127.0.0.1:{port}", **more}
    return {
        "name": "nodes",
        "duration_s": duration_s,
        "world": {"kind": "boxes", "boxes": [{"center": [6.0, 0.0, 0.5], "size": [0.2, 9.0, 1.0]}]},
        "radio": {"preset": "wifi-b-1", "loss": {"kind": "bernoulli", "probability": 0.3}},
        "stack": {"ros2": stack},
        "vehicles": {"kind": "p2dx", "sensors": sensors},
        "vehicle": [{"name": name, "pose": [0.0, float(k), 0.0]} for k, name in enumerate(GOALS)],
    }


def presence(folder: Path, vehicle: str) -> list[str]:
    with (folder / "run.mcap").open("rb") as stream:
        return [json.loads(data)["state"] for key, _, data in messages(stream) if key == f"{vehicle}/host"]


def end_of(result: Result, vehicle: str) -> tuple[float, float]:
    last = [each for each in result.states.to_pylist() if each["vehicle"] == vehicle][-1]
    return last["x"], last["y"]


def radio_lines(output: IO[str]) -> list[list[str]]:
    """Sender, content, level and age of each radio message received by a node."""
    return [line.split() for line in output]


def test_in_lock_step_runs_have_equal_bytes_and_radio_losses_by_table(port: int, tmp_path: Path) -> None:
    """By Twist and by TwistStamped."""
    runs, receptions = [], []
    for number, stamped in enumerate(((), ("--stamped",))):
        with node(port, "car1", *stamped) as one, node(port, "car2", *stamped) as two:
            runs.append(vcmvsp.run(scenario(port, "car1", "car2"), out=tmp_path / f"run{number}"))
            assert one.stdin
            one.stdin.close()
            assert one.stdout
            receptions.append(radio_lines(one.stdout))
            two.kill()
    first = runs[0]
    assert runs[1].metrics["digest"] == first.metrics["digest"]
    assert receptions[0] == receptions[1]
    for vehicle, goal in GOALS.items():
        assert end_of(first, vehicle) == pytest.approx(goal, abs=0.1)
    frames = [each for each in first.radio.to_pylist() if each["sender"] == "car2" and each["receiver"] == "car1"]
    number_of = {sent_ns: number for number, sent_ns in enumerate(sorted(each["sent_ns"] for each in frames), 1)}
    arrived = [each for each in frames if each["outcome"] == "received"]
    assert 40 < len(arrived) < 72  # of 80, with a loss of 0.3
    assert len(arrived) - len(receptions[0]) in {0, 1}  # a frame may arrive after the last tick
    for (sender, content, rssi, age), frame in zip(receptions[0], arrived, strict=False):
        assert (sender, int(content, 16)) == ("car2", number_of[frame["sent_ns"]])
        assert float(rssi) == pytest.approx(frame["rssi_dbm"], abs=1e-6)
        assert float(age) == pytest.approx(1e-9 * (frame["received_ns"] - frame["sent_ns"]), abs=1e-9)
    assert replay(tmp_path / "run0").metrics["digest"] == first.metrics["digest"]


def test_a_follower_of_the_platform_follows_the_reports_of_a_node(port: int, tmp_path: Path) -> None:
    run_config = scenario(port, "car1", duration_s=12.0)
    follow = {"kind": "leader_follower", "leader": "car1", "slot": [-1.0, 0.0]}
    run_config["vehicle"][1] |= {"agent": follow, "pose": [-1.0, 0.0, 0.0]}
    run_config["radio"] = {"preset": "ideal"}
    with node(port, "car1", "--report"):
        result = vcmvsp.run(run_config, out=tmp_path / "run")
    (x, y), (behind_x, behind_y) = (end_of(result, vehicle) for vehicle in GOALS)
    assert (x, y) == pytest.approx(GOALS["car1"], abs=0.1)
    assert math.hypot(x - behind_x, y - behind_y) == pytest.approx(1.0, abs=0.05)
    assert replay(tmp_path / "run").metrics["digest"] == result.metrics["digest"]


def test_in_real_time_a_node_drives_and_its_end_is_a_loss(port: int) -> None:
    run_config = scenario(port, "car1", duration_s=120.0, pace="wall")
    run_config["vehicle"].pop()
    with node(port, "car1") as process:

        def look(event: Event) -> None:
            if isinstance(event.value, VehicleState) and event.value.position[0] > 0.2:
                process.kill()

        with pytest.raises(FederateError, match=r"the node that published /car1/cmd_vel has gone"):
            vcmvsp.run(run_config, observe=look)


@pytest.mark.parametrize("on_lost", ["stop", "hold", "remove"])
def test_a_silent_node_is_lost_like_an_agent(port: int, tmp_path: Path, on_lost: str) -> None:
    run_config = scenario(port, "car1", duration_s=3.0)
    run_config["agents"] = {"on_lost": on_lost, "hold_s": 0.0, "deadline_s": 2.0}
    run_config["vehicle"].pop()
    with node(port, "car1", "--silent-after", "15"):
        if on_lost == "stop":
            with pytest.raises(FederateError, match=r"car1: no command on /car1/cmd_vel within 2 s"):
                vcmvsp.run(run_config)
            return
        result = vcmvsp.run(run_config, out=tmp_path / "run")
    assert presence(tmp_path / "run", "car1") == [{"hold": "lost", "remove": "removed"}[on_lost]]
    before, *_, after = result.states["vx"].to_numpy()[14:]
    assert abs(after) < 0.01 < abs(before)


def test_a_second_publisher_and_other_types_are_refused_by_name(port: int) -> None:
    lines: list[str] = []
    endpoints = Endpoint("MP", "car1/cmd_vel", TWIST), Endpoint("MP", "car1/cmd_vel", STRING)
    over = threading.Event()

    full_speed = encode_twist(Twist((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), stamped=False)

    def disturb() -> None:
        while True:
            with contextlib.suppress(FederateError):
                other = Node(f"tcp/127.0.0.1:{port}", "connect", RmwZenoh(0, "other"), endpoints)
                break
        says = [other.publisher(each, lambda _: None) for each in endpoints]
        while not over.wait(0.05):
            for say in says:
                say(full_speed)
        other.close()

    def tell(line: str) -> None:
        lines.append(line)
        if all(any(each in line for line in lines) for each in refusals):  # no node is left, and the run ends
            process.kill()
            over.set()

    refusals = "another node publishes it, too", f"it is {STRING}, not {TWIST} or geometry_msgs/msg/TwistStamped"
    run_config = scenario(port, "car1", duration_s=120.0, pace="wall")
    with node(port, "car1") as process:
        disturbing = threading.Thread(target=disturb)
        disturbing.start()
        with pytest.raises(FederateError, match="has gone"):
            vcmvsp.run(run_config, tell=tell)
        disturbing.join()
    assert sum("/car1/cmd_vel is refused" in line for line in lines) == 2
    assert any("car1: refused messages: " in line for line in lines)


def test_bytes_names_and_hashes_are_those_of_rmw_zenoh(port: int) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in OWN_TYPES.items():
        store.register(get_types_from_msg(text, name))
    run_config = scenario(port, "car1", duration_s=2.0)
    run_config["vehicles"]["sensors"] |= {"eye": {"kind": "camera", "rate_hz": 5.0}, "sat": {"kind": "gps", "rate_hz": 5.0}}
    run_config["vehicle"][1]["agent"] = {"kind": "trajectory", "path": "circle", "speed": 0.3, "yaw_rate": 0.2}
    samples: list[zenoh.Sample] = []
    tokens: set[str] = set()

    def listen() -> None:
        config = zenoh.Config.from_json5(
            f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"], timeout_ms: 20000, exit_on_failure: true}}}}'
        )
        with zenoh.open(config) as session:
            session.declare_subscriber("0/**", samples.append)
            session.liveliness().declare_subscriber(
                "@ros2_lv/**", lambda sample: tokens.add(str(sample.key_expr)), history=True
            )
            static = f"0/car1/tf_static/tf2_msgs::msg::dds_::TFMessage_/{store.hash_rihs01('tf2_msgs/msg/TFMessage')}"
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            zenoh.ext.declare_advanced_subscriber(session, static, samples.append, history=history)
            with node(port, "car1"):  # the run starts with the node
                over.wait(60.0)

    over = threading.Event()
    listening = threading.Thread(target=listen)
    listening.start()
    vcmvsp.run(run_config)
    over.set()
    listening.join()
    message_by_topic: dict[str, Any] = {}
    for sample in samples:
        _, *topic, kind, digest = str(sample.key_expr).split("/")
        name = kind.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
        assert digest == store.hash_rihs01(name)
        data, attachment = sample.payload.to_bytes(), sample.attachment
        message_by_topic["/".join(topic)] = message = store.deserialize_cdr(data, name)
        assert bytes(store.serialize_cdr(message, name)) == data
        assert attachment is not None
        assert len(attachment.to_bytes()) == 33
    inputs = "cmd_vel", "radio/send"  # inputs of the node
    parts = (
        "clock",
        *inputs,
        "odom",
        "tf",
        "tf_static",
        "radio/received",
        "scan",
        "inertia",
        "eye/image_raw",
        "eye/camera_info",
        "sat/fix",
    )
    assert {*message_by_topic} == {each if each == "clock" else f"car1/{each}" for each in parts}
    assert (message_by_topic["car1/odom"].header.frame_id, message_by_topic["car1/odom"].child_frame_id) == (
        "odom",
        "base_link",
    )
    assert [each.child_frame_id for each in message_by_topic["car1/tf"].transforms] == ["odom", "base_link"]
    frames = {each.child_frame_id: each for each in message_by_topic["car1/tf_static"].transforms}
    assert {*frames} == {"scan", "inertia", "eye", "sat"}
    turn = frames["eye"].transform.rotation  # body x is forward, the optical axis z: rotation by (-90, 0, -90) degrees
    assert (turn.w, turn.x, turn.y, turn.z) == pytest.approx((0.5, -0.5, 0.5, -0.5))
    picture, lens = message_by_topic["car1/eye/image_raw"], message_by_topic["car1/eye/camera_info"]
    assert len(picture.data) == picture.step * picture.height == 3 * lens.width * lens.height
    assert abs(message_by_topic["car1/sat/fix"].latitude) < 1e-3
    assert message_by_topic["car1/scan"].range_max == 20.0
    ends = {(part[9].replace("%", "/"), part[5]) for part in (each.split("/") for each in tokens) if len(part) == 13}
    assert {("/car1/cmd_vel", "MS"), ("/car1/odom", "MP"), ("/car1/scan", "MP")} <= ends


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"vehicles": ["car9"]}, r"stack\.ros2\.vehicles: .*car9"),
        ({"vehicles": ["car1", "car1"]}, r"stack\.ros2\.vehicles: car1 is driven twice"),
        ({"vehicles": ["car1"], "pase": "wall"}, r"stack\.ros2: .*pase|stack\.ros2\.pase"),
        ({"vehicles": ["car1"], "origin": [91.0, 0.0, 0.0]}, r"stack\.ros2\.origin: a latitude"),
    ],
)
def test_a_wrong_table_is_one_error(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        api.check({**scenario(7447, "car1"), "stack": {"ros2": change}})
    with pytest.raises(ScenarioError, match=r"stack\.ros1: .*ros2"):
        api.check({**scenario(7447, "car1"), "stack": {"ros1": {}}})


def test_without_a_node_lock_step_does_not_begin(port: int) -> None:
    run_config = scenario(port, "car1")
    run_config["agents"] = {"join_timeout_s": 0.2}
    with pytest.raises(FederateError, match=r"no node publishes /car1/cmd_vel within 0\.2 s"):
        vcmvsp.run(run_config)
    router = Node(f"tcp/127.0.0.1:{port}", "listen", RmwZenoh(0, "router"), ())
    with contextlib.closing(router), pytest.raises(FederateError, match="end the other router"):
        vcmvsp.run(run_config)
