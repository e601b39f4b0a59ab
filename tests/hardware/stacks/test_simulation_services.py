"""Services of simulation_interfaces: client of zenoh-ros2-sdk, with its own hashes and definitions."""

import contextlib
import json
import subprocess
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import vcmvsp
from tests.support.hardware.driver_runs import module_process
from tests.support.hardware.ros2_caller import MESSAGES, SERVICES, hash_of, with_packages
from vcmvsp.cosim.errors import Interrupted
from vcmvsp.cosim.recording import ros_messages as ros
from vcmvsp.cosim.recording.ros_services import register_service
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.hardware.drivers.ros2.node import Node
from vcmvsp.hardware.drivers.ros2.protocol import Endpoint, Origin, RmwZenoh, type_hash
from vcmvsp.hardware.stacks import simulation_services as services

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

CRATE = {"name": "crate", "solid": {"kind": "box", "center": [4.0, -2.0, 0.2], "size": [0.4, 0.4, 0.4]}, "mass_kg": 5.0}
PERIOD_NS = 100_000_000  # tick period


def scenario(port: int, duration_s: float = 4.0) -> dict[str, Any]:
    drives = {"kind": "trajectory", "path": "straight", "speed": 0.1}
    walls = [{"center": [6.0, 0.0, 0.5], "size": [0.2, 9.0, 1.0]}]
    return {
        "name": "services",
        "duration_s": duration_s,
        "world": {"kind": "boxes", "boxes": walls, "movables": [CRATE]},
        "radio": {"preset": "ideal"},
        "stack": {"ros2": {"vehicles": ["car1"], "pace": "lockstep", "endpoint": f"tcp/127.0.0.1:{port}"}},
        "agents": {"deadline_s": 60.0},
        "vehicles": {"kind": "p2dx"},
        "vehicle": [
            {"name": "car1"},
            {"name": "car2", "pose": [-2.0, 0.0, 0.0], "agent": drives},
        ],
    }


def answers_of(process: "subprocess.Popen[str]") -> list[tuple[str, Any]]:
    assert process.stdout
    line = next(each for each in process.stdout if each.startswith("["))  # other lines are radio messages received by its node
    return [(kind, response) for kind, response in json.loads(line)]


def stamp_ns(state: Any) -> int:
    return int(state["header"]["stamp"]["sec"]) * 10**9 + int(state["header"]["stamp"]["nanosec"])


def test_calls_pause_step_and_change_a_run_which_is_recorded_and_repeatable(port: int, tmp_path: Path) -> None:
    results, answers = [], []
    for number in range(2):
        with module_process("ros2_caller", port) as process:
            results.append(vcmvsp.run(scenario(port), out=tmp_path / f"run{number}"))
            answers.append(answers_of(process))
    responses: list[tuple[str, Any]] = answers[0]
    assert answers[1] == responses
    assert results[1].metrics["digest"] == results[0].metrics["digest"]
    ((_, features),) = [each for each in responses if each[0] == "GetSimulatorFeatures"]
    assert features["features"]["features"] == [10, 11, 24, 25, 26, 31, 32]  # features of the other calls
    codes = [(kind, response["result"]["result"]) for kind, response in responses if "result" in response]
    assert [code for kind, code in codes if kind == "SetSimulationState"] == [1, 101, 0, 1]
    assert [code for kind, code in codes if kind == "GetEntities"] == [1, 1, 4, 0, 0]
    assert [code for kind, code in codes if kind == "GetEntityState"] == [2, 1, 1, 1]
    assert [code for kind, code in codes if kind == "StepSimulation"] == [1, 1, 4, 1]
    assert [code for kind, code in codes if kind == "SetEntityState"] == [1, 0, 2, 101, 101, 0, 4]
    assert ("ResetSimulation", 0) in codes
    assert [response["state"]["state"] for kind, response in responses if kind == "GetSimulationState"] == [2]
    names = [response["entities"] for kind, response in responses if kind == "GetEntities"]
    assert names[:2] == [["car1", "car2", "crate"], ["car1", "car2"]]
    states = [response["state"] for kind, response in responses if kind == "GetEntityState"][1:]
    times = [stamp_ns(each) for each in states]
    assert [b - a for a, b in pairwise(times)] == [PERIOD_NS, 10 * PERIOD_NS]
    before, _, after = (each["pose"]["position"]["x"] for each in states)
    assert before == pytest.approx(0.0, abs=1e-6)
    assert after > 0.05
    table = [each for each in results[0].states.to_pylist() if each["vehicle"] == "car1" and each["time_ns"] == times[-1]]
    assert after == pytest.approx(table[0]["x"], abs=1e-12)
    ((_, all_states),) = [each for each in responses if each[0] == "GetEntitiesStates"]
    crate = all_states["states"][all_states["entities"].index("crate")]["pose"]
    assert [crate["position"][axis] for axis in "xy"] == pytest.approx([4.0, 2.0], abs=0.01)
    assert abs(crate["orientation"]["z"]) == pytest.approx(1.0, abs=1e-3)
    (move,) = tomllib.loads((tmp_path / "run0" / "scenario.toml").read_text())["intervention"]
    assert (move["kind"], move["obstacle"], *move["position"]) == ("move", "crate", 4.0, 2.0)
    assert replay(tmp_path / "run0").metrics["digest"] == results[0].metrics["digest"]


def test_a_call_ends_a_run_like_an_operator(port: int) -> None:
    with module_process("ros2_caller", port, "--quit"), pytest.raises(Interrupted) as ended:
        vcmvsp.run(scenario(port, 1000.0))
    assert ended.value.result is not None


def test_hashes_are_those_of_rmw_zenoh_and_of_the_sdk() -> None:
    services.register()
    for kind in SERVICES:
        assert type_hash(f"simulation_interfaces/srv/{kind}") == hash_of(kind)
    register_service("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b", "int64 sum")
    # from the design document of rmw_zenoh
    published = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    assert type_hash("example_interfaces/srv/AddTwoInts") == published


def test_rosbags_reads_and_writes_every_request_and_response_to_the_same_bytes() -> None:
    services.register()
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in MESSAGES.items():
        store.register(get_types_from_msg(with_packages(text), f"simulation_interfaces/msg/{name}"))
    for kind, parts in SERVICES.items():
        for part, text in zip(("Request", "Response"), parts, strict=True):
            store.register(get_types_from_msg(with_packages(text), f"simulation_interfaces/msg/{kind}{part}"))
            ours = f"simulation_interfaces/srv/{kind}_{part}"
            assert ros.store().fielddefs[ours][1] == store.fielddefs[f"simulation_interfaces/msg/{kind}{part}"][1]
    for service, (kind, _, _) in services.SERVICES.items():
        if not kind.startswith("GetSimulat"):  # these services cannot fail
            data = services.encoded(service, services.failed(service, 4, "why"))
            message = store.deserialize_cdr(data, f"simulation_interfaces/msg/{kind}Response")
            assert bytes(store.serialize_cdr(message, f"simulation_interfaces/msg/{kind}Response")) == data


def test_a_service_has_token_and_answer_of_rmw_zenoh(port: int) -> None:
    services.register()
    endpoint = Endpoint("SS", "get_entities", "simulation_interfaces/srv/GetEntities")
    mapping = RmwZenoh(0, "vcmvsp")
    token, _ = mapping.tokens("a1", (endpoint,))
    dds = "simulation_interfaces::srv::dds_::GetEntities_"
    digest = hash_of("GetEntities")
    assert token == f"@ros2_lv/0/a1/0/1/SS/%/%/vcmvsp/%get_entities/{dds}/{digest}/::,10:,:,:,,"
    key, gid = f"0/get_entities/{dds}/{digest}", bytes(range(16))
    request = mapping.attachment(Origin(7, 123, gid))
    with contextlib.closing(Node(f"tcp/127.0.0.1:{port}", "listen", mapping, (endpoint,))) as node:
        node.serve(endpoint, lambda call: call.reply(call.data[::-1]))
        config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}')
        with zenoh.open(config) as session:
            (reply,) = session.get(key, payload=b"abc", attachment=request, target=zenoh.QueryTarget.ALL_COMPLETE)
            assert list(session.get(key, payload=b"abc")) == []  # without an attachment
    assert reply.ok is not None
    assert reply.ok.attachment is not None
    attachment = reply.ok.attachment.to_bytes()
    assert (str(reply.ok.key_expr), reply.ok.payload.to_bytes()) == (key, b"cba")
    assert (attachment[:8], attachment[16:]) == ((7).to_bytes(8, "little"), b"\x10" + gid)
