"""Unchanged cflib programs, in processes of their own, fly simulated Crazyflies."""

import json
import math
import random
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

import vcmvsp
from tests.support.netsim.gateway_context import free_ports
from tests.support.paths import ROOT
from vcmvsp.cosim.errors import FederateError, Interrupted, ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts.remote_host import LinkError
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.types import VehicleState
from vcmvsp.hardware.stacks.crazyflie import FALL_M_PER_S, Commander
from vcmvsp.hardware.stacks.crtp import LOG, PARAMETERS, Crazyflie, Flight, Manoeuvre, Order, Release, SetPoint, Stop
from vcmvsp.hardware.stacks.trajectories import HEADER, PIECE, START

UPLOAD = PIECE.pack(*range(32), 2.0) + START.pack(0, 0, 500, 0) + HEADER.pack(1, 1500) + b"\x64\0"
MOTION_M_PER_S = 0.2  # speed of cflib's MotionCommander, which times distance / speed by the wall clock
NAMES = ("cf1", "cf2", "cf3")


def scenario(first: int, duration_s: float, **more: Any) -> dict[str, Any]:
    return {
        "name": "crazyflies",
        "duration_s": duration_s,
        "physics": {"kind": "bullet", "rate_hz": 250.0},
        "agents": {"period_s": 0.02, "on_lost": "hold"},
        "stack": {"crazyflie": {"vehicles": list(NAMES), "first_port": first, **more}},
        "vehicles": {"kind": "crazyflie"},
        "vehicle": [{"name": name, "position": [float(k), 0.0, 0.0]} for k, name in enumerate(NAMES)],
    }


def program(name: str, *ports: int) -> "subprocess.Popen[str]":
    uris = [f"udp://127.0.0.1:{port}" for port in ports]
    words = [sys.executable, "-m", "tests.support.hardware.cflib_programs", name, *uris]
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def flown(first: int, speed: float, *programs: tuple[str, *tuple[int, ...]], tell: Callable[[str], None]) -> list[Any]:
    """Output of each program, given its aircraft; the last one to end ends the run.

    Args:
        first: port of the first aircraft.
        speed: simulated seconds per wall second; programs that wait by the clock of the aircraft fly faster, too.
        programs: name and aircraft of each.
        tell: receives the lines of the run.
    """
    started: list[subprocess.Popen[str]] = []

    def start(line: str) -> None:
        if "reach" in line:
            started.extend(program(name, *(first + number for number in numbers)) for name, *numbers in programs)
        tell(line)

    def end(event: Event) -> None:
        if all(each.poll() is not None for each in started):
            raise KeyboardInterrupt

    with pytest.raises(Interrupted):
        vcmvsp.run(scenario(first, 200.0), realtime=speed, tell=start, observe=end)
    return [json.loads(each.communicate(timeout=20.0)[0]) for each in started]


@pytest.mark.processes
@pytest.mark.sockets
def test_a_connection_brings_tables_and_flies_a_square_and_a_second_program_is_refused() -> None:
    first, lines = free_ports(len(NAMES)), list[str]()

    def tell(line: str) -> None:
        lines.append(line)
        if "reach" in line:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                for _ in range(2):  # the first one claims the aircraft, until a program connects
                    other.sendto(b"\x80\x03\x00", ("127.0.0.1", first + 1))
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as third:
                third.bind(("127.0.0.1", 0))
                third.sendto(b"\x80\x03\x00", ("127.0.0.1", first + 1))

    square, (tables,) = (each.values() for each in flown(first, 1.0, ("square", 0), ("tables", 2), tell=tell))
    ((corners, height),), x, y = square, 0.0, 0.0
    for (flown_s, corner), (ahead, left) in zip(corners, [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], strict=True):
        x, y = x + MOTION_M_PER_S * flown_s * ahead, y + MOTION_M_PER_S * flown_s * left
        assert corner[:2] == pytest.approx([x, y], abs=0.05)
        assert corner[2] > 0.25
    assert corner[2] == pytest.approx(height, abs=0.05)
    assert height > 0.29  # the more, the longer its process stood still: MotionCommander rises by the wall clock
    assert tables["log"] == sorted(LOG)
    assert {*tables["param"]} == {*PARAMETERS}
    assert float(tables["param"]["kalman.initialX"]) == 1.5
    assert any(line == "stack.crazyflie: cf2: refused packets: 1 second program" for line in lines)


@pytest.mark.processes
@pytest.mark.sockets
def test_programs_of_cflib_fly_a_swarm_and_trajectories() -> None:
    first = free_ports(len(NAMES))
    swarm, flight = flown(first, 3.0, ("go_to", 0, 1), ("trajectories", 2), tell=lambda _: None)
    assert len(swarm) == 2
    for uri, places in swarm.items():
        x = float(int(uri.rpartition(":")[2]) - first)
        for place, expected in zip(places, [(x, 0.0, 0.4), (x + 0.4, 0.6, 0.8), (x + 0.4, 0.6, 0.02)], strict=True):
            assert place == pytest.approx(expected, abs=0.05)
    for place, expected in zip(*flight.values(), [(2.0, 0.0, 0.5), (2.0, 0.4, 0.5), (1.6, 0.4, 0.8)], strict=True):
        assert place == pytest.approx(expected, abs=0.05)


@pytest.mark.sockets
def test_a_port_in_use_is_one_error() -> None:
    first = free_ports(len(NAMES))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", first + 1))
        with pytest.raises(FederateError, match=rf"port {first + 1} of 127\.0\.0\.1 for cf2 cannot be opened.*set first_port"):
            vcmvsp.run(scenario(first, 1.0))


def test_only_vehicles_that_fly_are_crazyflies() -> None:
    with pytest.raises(ScenarioError, match=r"stack\.crazyflie\.vehicles: cf1 does not fly"):
        api.check({**scenario(19850, 1.0), "vehicles": {"kind": "p2dx"}})


def valid_packets() -> list[bytes]:
    """One packet of each kind."""
    four = struct.pack("<ffff", 0.1, 0.2, 0.3, 4.0)
    return [
        b"\xff",
        b"\xf1\x00",
        b"\xf0hello",
        b"\xd1\x00",
        b"\xd0\x01\x01",
        *(bytes([port, command]) for port in (0x20, 0x50) for command in (2, 3)),
        b"\x20\x02\x05\x00",
        b"\x21\x01\x00",
        b"\x22\x04\x00" + struct.pack("<f", 1.0),
        b"\x51\x05",
        b"\x51\x06\x01" + struct.pack("<BHBH", 7, 0, 0x77, 1),
        b"\x51\x03\x01\x02",
        b"\x51\x04\x01",
        b"\x51\x02\x01",
        b"\x40\x01",
        b"\x40\x02\x00",
        b"\x41\x00" + struct.pack("<IB", 0, 24),
        *(b"\x42\x00" + struct.pack("<I", at) + UPLOAD[at : at + 20] for at in range(0, len(UPLOAD), 20)),
        b"\x80\x06" + struct.pack("<BBBIB", 1, 1, 0, 0, 1),
        b"\x80\x06" + struct.pack("<BBBIB", 2, 1, 1, 132, 1),
        b"\x80\x0d\x00" + struct.pack("<???Bf", True, True, False, 1, 2.0),
        b"\x80\x0d\x00" + struct.pack("<???Bf", False, False, False, 2, 1.0),
        b"\x30" + struct.pack("<fffH", 0.0, 0.0, 0.0, 0),
        *(b"\x70" + bytes([kind]) + four for kind in (1, 5, 7, 8, 10)),
        b"\x70\x06" + struct.pack("<hhhhhhhhhIhhh", *range(9), 0x40000000, 0, 0, 100),
        b"\x71\x00" + struct.pack("<I", 0),
        b"\x80\x07\x00" + struct.pack("<ff?f", 1.0, 0.0, False, 2.0),
        b"\x80\x0c\x00\x00\x00" + struct.pack("<fffff", 1.0, 2.0, 1.0, 0.0, 2.0),
        b"\x60" + four[:12],
        b"\x61\x03",
    ]


def finite(order: Order) -> bool:
    numbers = [each for value in order for each in (value if isinstance(value, tuple) else (value,))]
    return all(math.isfinite(each) for each in numbers if isinstance(each, float))


def test_mutated_packets_are_answered_or_refused() -> None:
    orders: list[Order] = []
    aircraft, rng = Crazyflie(orders.append), random.Random(1)
    packets, state = valid_packets(), VehicleState(position=(0.0, 0.0, 1.0))
    for number in range(50_000):
        packet = bytearray(rng.choice(packets))
        for _ in range(rng.randrange(4)):
            packet[rng.randrange(len(packet))] = rng.randrange(256)
        if rng.random() < 0.2:
            packet = packet[: rng.randrange(len(packet) + 1)] + rng.randbytes(rng.randrange(4))
        answers = aircraft.take(bytes(packet)) + aircraft.logged(10 * number, state)
        assert all(1 <= len(each) <= 31 for each in answers)
    assert all(map(finite, orders))
    assert {Stop, Release, SetPoint, Manoeuvre, Flight} == {type(each) for each in orders}


def test_set_points_age_as_in_the_firmware() -> None:
    commander, state = Commander(), VehicleState(position=(0.0, 0.0, 1.0))
    commander.take(SetPoint(velocity=(0.3, 0.0, 0.0)), state, 0.0)
    fresh = commander.command(state, 0.4)
    old = commander.command(state, 1.0)
    assert fresh.linear == (0.3, 0.0, 0.0)
    assert old.linear == (0.0, 0.0, 0.0)
    with pytest.raises(LinkError, match="no set-point for 2 s"):
        commander.command(state, 2.1)
    commander.take(SetPoint(velocity=(0.1, 0.0, 0.0)), state, 3.0)
    commander.take(Release(), state, 3.1)  # the high-level commander holds the place
    held = commander.command(VehicleState(position=(0.1, 0.0, 1.0)), 60.0)
    assert held.linear[0] < 0.0
    commander.take(Stop(), state, 61.0)
    fallen = commander.command(state, 61.0)
    assert fallen.linear == (0.0, 0.0, -FALL_M_PER_S)


def test_a_go_to_begins_and_ends_at_rest() -> None:
    commander, start = Commander(), VehicleState(position=(1.0, 0.0, 1.0))
    commander.take(Manoeuvre("go_to", (1.0, 0.0, 0.0), 0.0, 2.0, relative=True), start, 0.0)
    speeds: list[float] = []
    for tick in range(101):
        now_s = 0.02 * tick
        at = start.position[0] + sum(0.02 * each for each in speeds)  # ideal tracking
        command = commander.command(VehicleState(position=(at, 0.0, 1.0)), now_s)
        speeds.append(command.linear[0])
    assert speeds[0] == pytest.approx(0.0, abs=1e-9)
    assert speeds[-1] == pytest.approx(0.0, abs=0.05)
    assert max(speeds) == pytest.approx(140.0 / 64.0 / 2.0, rel=0.05)  # maximum of the polynomial, at half time
    assert 1.0 + sum(0.02 * each for each in speeds) == pytest.approx(2.0, abs=0.02)
