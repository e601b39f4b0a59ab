"""Firmware in the loop: a scripted autopilot process flies simulated quadrotors by its published protocol."""

import contextlib
import itertools
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.netsim.gateway_context import free_ports
from tests.support.paths import ROOT
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.runs.result import Result
from vcmvsp.cosim.types import Array, Waypoint

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

PROGRAM = ROOT / "tests" / "support" / "hardware" / "scripted_autopilot.py"
KINDS = ("ardupilot", "px4")
PORTS = {
    "ardupilot": (9002, 10, socket.SOCK_DGRAM),
    "betaflight": (9001, 0, socket.SOCK_DGRAM),
    "px4": (4560, 1, socket.SOCK_STREAM),
}


def send_datagrams(port: int, over: threading.Event) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        while not over.wait(0.01):
            link.sendto(bytes(40), ("127.0.0.1", port))


def send_request(port: int, over: threading.Event) -> None:
    while not over.wait(0.01):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)) as link:
            link.sendall(b"GET / HTTP/1.1" * 10)
            over.wait()


STEPS_HZ = 250.0


def is_free(port: int, kind: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


_taken = itertools.count(100 + 7 * (time.monotonic_ns() % 50))


def instances(kind: str, count: int = 1) -> list[int]:
    """Instances with free ports."""
    first, step, sort = PORTS[kind]
    free = (number for number in _taken if is_free(first + step * number, sort))
    return [next(free) for _ in range(count)]


def command(kind: str, *options: str) -> str:
    return f"{sys.executable} {PROGRAM} {kind} --instance {{instance}} {' '.join(options)}"


def scenario(kind: str, numbers: list[int], duration_s: float = 11.0, **more: Any) -> dict[str, Any]:
    """Quadrotors on the floor, 3 m apart, with headings of 0.4 k rad."""
    vehicles = [
        {
            "name": f"uav{k}",
            "kind": "quadrotor",
            "position": [3.0 * k, 0.0, 0.0],
            "heading": 0.4 * k,
            "firmware": {"kind": kind, "instance": number, "command": command(kind), **more},
        }
        for k, number in enumerate(numbers)
    ]
    return {
        "name": "firmware",
        "duration_s": duration_s,
        "physics": {"kind": "bullet", "rate_hz": STEPS_HZ},
        "agents": {"deadline_s": 60.0},
        "vehicle": vehicles,
    }


def track(result: Result, vehicle: str) -> Callable[[float], Array]:
    """Position of a vehicle at a recorded time, s."""
    rows = result.states.to_pandas().query("vehicle == @vehicle")

    def at(time_s: float) -> Array:
        row = rows[rows.time_ns == round(1e9 * time_s)]
        assert len(row) == 1
        return np.asarray(row[["x", "y", "z"]].to_numpy(float)[0])

    return at


@pytest.mark.parametrize("kind", KINDS)
def test_several_take_off_fly_to_way_points_and_land(kind: str) -> None:
    result = vcmvsp.run(scenario(kind, instances(kind, 2)))
    for k in range(2):
        at, start = track(result, f"uav{k}"), np.array([3.0 * k, 0.0, 0.04])
        goals = {3.0: (0.0, 0.0, 1.0), 5.5: (0.0, 1.5, 1.0), 8.0: (1.0, 1.5, 1.0), 11.0: (1.0, 1.5, 0.0)}  # east, north, up
        for time_s, goal in goals.items():
            assert at(time_s) == pytest.approx(start + np.array(goal), abs=0.1)  # PX4's truth has steps of 1 cm
    states = result.states.to_pandas()
    end = states[states.time_ns == states.time_ns.max()]
    assert 2.0 * np.arctan2(end.qz, end.qw).to_numpy() == pytest.approx([0.0, 0.4], abs=0.05)  # headings are kept
    assert np.abs(end[["vx", "vy", "vz"]].to_numpy()).max() < 0.02  # on the floor, rotors off


def test_equal_firmware_gives_equal_bytes(tmp_path: Path) -> None:
    numbers = instances("ardupilot", 2)
    for name in ("one", "two"):
        vcmvsp.run(scenario("ardupilot", numbers, duration_s=3.0), out=tmp_path / name)
    one, two = (tmp_path / name / "run.mcap" for name in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    text = (tmp_path / "one" / "scenario.toml").read_text("utf-8")
    assert 'frame = "x"' in text
    assert "timeout_s = 10.0" in text  # the resolved scenario is complete


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_ends_with_its_firmware_and_its_exit_code(kind: str, tmp_path: Path) -> None:
    table = scenario(kind, instances(kind), command=command(kind, "--stop", "3.5"))
    with pytest.raises(FederateError, match="firmware of uav0 is lost") as caught:
        vcmvsp.run(table, out=tmp_path / "out")
    assert caught.value.exit_code == 3
    assert track(caught.value.result, "uav0")(3.0)[2] == pytest.approx(1.04, abs=0.1)
    if kind == "ardupilot":  # the end of PX4's connection may be detected first
        assert "ended with exit code 3, last line: told to stop" in str(caught.value)


@pytest.mark.parametrize(
    ("on_lost", "height_m", "engine"), [("fall", 0.04, "bullet"), ("hold", 1.04, "bullet"), ("fall", 0.04, "mujoco")]
)
def test_a_vehicle_without_firmware_falls_or_holds_and_the_others_fly_on(on_lost: str, height_m: float, engine: str) -> None:
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    table = scenario("ardupilot", instances("ardupilot", 2), duration_s=5.5)
    table["physics"]["kind"] = engine
    table["vehicle"][0]["firmware"] |= {"on_lost": on_lost, "command": command("ardupilot", "--stop", "3")}
    result = vcmvsp.run(table)
    assert track(result, "uav0")(5.5)[2] == pytest.approx(height_m, abs=0.1)
    assert track(result, "uav1")(5.5) == pytest.approx([3.0, 1.5, 1.04], abs=0.1)


@contextlib.contextmanager
def started(*words: str | Path) -> Iterator["subprocess.Popen[bytes]"]:
    """A Python process, killed at the end."""
    with subprocess.Popen([sys.executable, *words]) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("kind", KINDS)
def test_hanging_firmware_started_by_hand_times_out(kind: str) -> None:
    (number,) = instances(kind)
    table = scenario(kind, [number], command="", timeout_s=0.5)
    with started(PROGRAM, kind, "--instance", str(number)) as process:

        def hang(event: Any) -> None:
            if event.time_ns > 1_000_000_000:
                process.send_signal(signal.SIGSTOP)

        with pytest.raises(FederateError, match=r"uav0 is lost: no outputs came for 0\.5 s"):
            vcmvsp.run(table, observe=hang)


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_firmware_error_says_how_to_start_it(kind: str) -> None:
    (number,) = instances(kind)
    first, step, _ = PORTS[kind]
    with pytest.raises(
        FederateError, match=f"within 0.3 s; start it by hand, instance {number}, for port {first + step * number}"
    ):
        vcmvsp.run(scenario(kind, [number], command="", start_s=0.3))


def test_a_missing_program_and_a_used_port_are_errors() -> None:
    (number,) = instances("ardupilot")
    with pytest.raises(FederateError, match="no-such-autopilot cannot be started: No such file"):
        vcmvsp.run(scenario("ardupilot", [number], command="no-such-autopilot"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 9002 + 10 * number))
        with pytest.raises(FederateError, match=f"port {9002 + 10 * number} for uav0 cannot be opened"):
            vcmvsp.run(scenario("ardupilot", [number]))


@pytest.mark.parametrize(
    ("kind", "send", "refused"),
    [
        ("ardupilot", send_datagrams, r"\d+ datagrams of another protocol"),
        ("betaflight", send_datagrams, r"\d+ datagrams of another protocol"),
        ("px4", send_request, "140 bytes without a MAVLink message"),
    ],
)
def test_data_of_another_protocol_are_counted_and_named(
    kind: str, send: Callable[[int, threading.Event], None], refused: str, stack: contextlib.ExitStack
) -> None:
    first, step, sort = PORTS[kind]
    if kind == "betaflight" and not is_free(first, sort):
        pytest.skip(f"UDP port {first} is used")
    (number,) = instances(kind)
    over = threading.Event()
    sender = threading.Thread(target=send, args=(first + step * number, over))
    sender.start()
    stack.callback(sender.join)
    stack.callback(over.set)
    with pytest.raises(FederateError, match=f"there were {refused}"):
        vcmvsp.run(scenario(kind, [number], command="", start_s=0.5))


class ToPlace(vcmvsp.Agent):
    """Flies 1.5 m east, then to a place."""

    period = 0.5
    east = False

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity | Waypoint:
        self.east = self.east or obs.state.position[0] > 1.5
        return Waypoint(position=(2.0, 1.0, 2.0)) if self.east else vcmvsp.Velocity(linear=(0.5, 0.0, 0.0))


@pytest.mark.parametrize("kind", KINDS)
def test_an_agent_commands_firmware_over_mavlink(kind: str) -> None:
    port = free_ports(1)
    options = {"command": command(kind, "--commanded", str(port)), "mavlink": f"udpin:127.0.0.1:{port}", "takeoff_m": 1.0}
    table = scenario(kind, instances(kind), duration_s=20.0, **options)
    result = vcmvsp.run({**table, "vehicle": [{**table["vehicle"][0], "agent": {}}]}, agents={"uav0": ToPlace()})
    states = result.states.to_pandas()
    east = states[(states.x > 0.5) & (states.x.cummax() < 1.5)]
    assert east.z.to_numpy() == pytest.approx(1.0, abs=0.3)  # took off before
    assert east.vx.to_numpy() == pytest.approx(0.5, abs=0.07)  # its controller has no integral part
    assert track(result, "uav0")(20.0) == pytest.approx([2.0, 1.0, 2.0], abs=0.1)
