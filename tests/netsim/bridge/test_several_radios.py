"""Several radios of a vehicle: programs reach each, and lose the datagrams that the recording lists as lost on that radio."""

import contextlib
import json
import os
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd
import pyarrow.parquet as pq
import pytest
import tomli_w

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import VCMVSP
from tests.support.docs.readme_pages import block
from tests.support.netsim.bridge_runs import sent_repeatedly
from tests.support.netsim.gateway_context import PATIENCE_S, RunlessContext, free_ports, open_gateway
from tests.support.netsim.vehicle_namespaces import IN_NAMESPACES, RUN, network_up, next_datagram, run_command, udp
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.runs.api import check
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.netsim.bridge.gateways.base import BROADCAST
from vcmvsp.netsim.bridge.gateways.ip import ethernet
from vcmvsp.netsim.bridge.gateways.ip.gateway import Ip, network_after, network_of

T = TypeVar("T", bound=Callable[..., Any])
PAGE = "netsim/bridge/README.md"
NAME = f"radios{os.getpid()}"
LOSS = {"near": 0.3, "far": 0.0}
SIZES = {"near": 120, "far": 240}  # payload, bytes, that tells datagrams from the kernel's own packets
ADDRESSES = {"near": ("10.77.0.1", "10.77.0.2"), "far": ("10.78.0.1", "10.78.0.2")}
COUNT = 200
COMMANDS = [
    line.partition("  #")[0].strip().replace("lora", "far") for line in block(PAGE, "ping car2.lora").splitlines() if line
]


def scenario(**own: Any) -> dict[str, Any]:
    """Two cars with two radios, and a third one with the second radio alone."""
    radios = [{"name": name, "loss": {"probability": loss}, "delay": {"seconds": 0.01}} for name, loss in LOSS.items()]
    cars = [{"name": f"car{i}", "position": [float(i), 0.0, 0.0]} for i in (1, 2, 3)]
    cars[2]["radios"] = ["far"]
    return {
        "name": NAME,
        "duration_s": 1.5,
        "physics": {"kind": "kinematic"},
        "vehicles": {"kind": "kinematic"},
        "radio": radios,
        "vehicle": cars,
        **own,
    }


def in_namespaces(test: T) -> T:
    """Marks a test that makes network namespaces of Linux."""
    for mark in (*IN_NAMESPACES, pytest.mark.needs("ping")):
        test = mark(test)
    return test


def frames_of(folder: Path) -> pd.DataFrame:
    rows = pq.read_table(folder / "radio.parquet").to_pandas()
    return rows.astype({"radio": str, "sender": str, "receiver": str, "outcome": str})


@pytest.mark.processes
@pytest.mark.sockets
@pytest.mark.parametrize("agents", [False, True])
def test_gateways_have_the_radio_of_their_tables_and_a_replay_repeats_both(agents: bool, tmp_path: Path) -> None:
    first = free_ports(600)
    ports = {"near": first, "far": first + 300}
    gateways = {name: {"kind": "udp", "radio": name, "first_port": port} for name, port in ports.items()}
    datagrams = {port: bytes(SIZES[name]) for name, first in ports.items() for port in (first, first + 3)}
    with sent_repeatedly(datagrams, 1000):  # to all, and to car3
        vcmvsp.run(scenario(bridge={"agents": agents, **gateways}), out=tmp_path / "run")
    frames = frames_of(tmp_path / "run")
    for name, size in SIZES.items():
        assert set(frames[frames["size_bytes"] == size].radio) == {name}
    assert set(zip(frames.radio, frames.receiver, strict=True)) == {("near", "car2"), ("far", "car2"), ("far", "car3")}
    outcomes = Counter(zip(frames.radio, frames.outcome, strict=True))
    assert outcomes["near", "random loss"] > 0
    assert outcomes["far", "random loss"] == 0
    deliveries = pq.read_table(tmp_path / "run" / "bridge.parquet").to_pandas()
    arrived = frames[frames.outcome.isin(("received", "under way"))].set_index(["frame", "receiver"])  # after the end
    for frame, receiver, gateway in zip(deliveries.frame, deliveries.receiver, deliveries.door, strict=True):
        assert arrived.loc[(frame, receiver), "radio"] == gateway
    about = json.loads((tmp_path / "run" / "about.json").read_text())["bridge"]
    assert about["counts"]["car1"]["not on the radio near, which sender or destination lack"] > 0  # to car3

    again = replay(tmp_path / "run", out=tmp_path / "again")
    for name in ("radio.parquet", "metrics.json"):
        assert (tmp_path / "run" / name).read_bytes() == (again.folder / name).read_bytes()  # type: ignore[operator]


def on(vehicle: str, *words: str) -> str:
    """Output of a command on a vehicle's machine."""
    command = [*VCMVSP, "net", "exec", vehicle, "--run", NAME, "--", *words]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert result.returncode == 0, f"{words}: {result.stdout}{result.stderr}"
    return result.stdout


def answered(vehicle: str, ping: str) -> None:
    """Repeats a ping until an answer comes: it ends without one if the kernel's three requests for the address are lost."""
    on(vehicle, "sh", "-c", f"until {ping} -c 1 -i 0.2 -w 5; do :; done")


def received(listener: socket.socket) -> list[int]:
    """Numbers of the datagrams that wait in a socket."""
    numbers = []
    with contextlib.suppress(BlockingIOError):
        while True:
            numbers.append(int.from_bytes(listener.recv(4096)[:4], "big"))
    return numbers


@in_namespaces
def test_datagrams_are_lost_as_recorded_on_their_radio(tmp_path: Path) -> None:
    """The recording lists the datagrams that must arrive; the machine's load changes neither."""
    (tmp_path / "radios.toml").write_text(tomli_w.dumps(scenario(duration_s=600.0)))
    with contextlib.ExitStack() as open_sockets:
        with network_up(tmp_path / "radios.toml", NAME):
            output = vcmvsp_command("net", "status").out
            listeners = {}
            for name, (own, other) in ADDRESSES.items():
                sender = open_sockets.enter_context(udp("car1", own, run=NAME))
                listeners[name] = open_sockets.enter_context(udp("car2", other, 9000, run=NAME))
                answered("car1", f"ping {other}")  # ARP has then resolved it
                for number in range(COUNT):
                    sender.sendto(number.to_bytes(4, "big") + bytes(SIZES[name] - 4), (other, 9000))
                    time.sleep(0.002)
            names = on("car3", "cat", "/etc/hosts")
            for command in COMMANDS:
                vehicle, _, words = command.partition(" -- ")
                if words.startswith("ping"):
                    answered(vehicle.split()[-1], words)
                else:
                    on(vehicle.split()[-1], *words.split())
            routes = on("car1", "ip", "route", "get", "10.77.0.2")
        came = {name: received(listener) for name, listener in listeners.items()}
    frames = frames_of(tmp_path / "out")
    deliveries = pq.read_table(tmp_path / "out" / "bridge.parquet").to_pandas()
    made = {*deliveries[deliveries.late_s.notna()].frame}
    for name, size in SIZES.items():
        sent = frames[frames["size_bytes"] == size + 28]  # with the headers of UDP and IPv4
        assert set(zip(sent.radio, sent.sender, sent.receiver, strict=True)) == {(name, "car1", "car2")}
        assert len(sent) > COUNT / 2
        arrived = sent[sent.outcome == "received"].frame
        assert len(came[name]) == len({*arrived} & made)
        assert len({*came[name]}) == len(came[name])
        share = (sent.outcome == "random loss").mean()
        assert abs(share - LOSS[name]) < 6.5 * (0.25 / len(sent)) ** 0.5  # missed once in 10^9 runs: frames are not the same
    assert " via 10.78.0.2 dev far " in routes
    assert set(frames[frames.radio == "near"].receiver) <= {"car1", "car2"}
    hosts = ["10.77.0.1\tcar1 car1.near", "fd77::1\tcar1 car1.near", "10.78.0.1\tcar1.far", "fd77:0:0:1::1\tcar1.far"]
    assert {*hosts, "10.78.0.3\tcar3 car3.far"} <= {*names.splitlines()}
    status = [line.split() for line in output.splitlines()]
    for row in (
        ["car1", "near", "10.77.0.1", "fd77::1"],
        ["far", "10.78.0.1", "fd77:0:0:1::1"],
        ["car3", "far", "10.78.0.3", "fd77:0:0:1::3"],
    ):
        assert row in status


@in_namespaces
async def test_the_routing_table_chooses_the_radio() -> None:
    radios = {"near": (0, 1), "far": (0, 1, 2)}
    context = RunlessContext(("car1", "car2", "car3"), run=RUN, radios=radios)
    async with open_gateway(Ip(), context):
        links = {}
        for vehicle in context.vehicles:
            _, output = await run_command(vehicle, "ip", "-br", "link")
            links[vehicle] = {line.split()[0]: line.split()[2] for line in output.splitlines()}
            del links[vehicle]["lo"]
        for address, radio in (("10.77.0.2", "near"), ("fd77::2", "near"), ("10.78.0.2", "far"), ("fd77:0:0:1::2", "far")):
            with udp("car1", "::" if ":" in address else "0.0.0.0") as sender, udp("car2", address, 9000) as listener:
                context.offered.clear()
                sender.sendto(b"to one", (address, 9000))
                await next_datagram(listener)
            # The kernel may ask for a neighbour's address at any time, on either radio.
            assert [each.radio for each in context.offered if each.payload.endswith(b"to one")] == [radio]
        await run_command("car1", "ip", "route", "add", "10.77.0.2/32", "via", "10.78.0.2")
        with udp("car1", "10.77.0.1") as sender, udp("car2", "10.77.0.2", 9000) as listener:
            context.offered.clear()
            sender.sendto(b"by far", ("10.77.0.2", 9000))
            assert await next_datagram(listener) == (b"by far", "10.77.0.1")
        assert [each.radio for each in context.offered if each.payload.endswith(b"by far")] == ["far"]
    macs = {name: [ethernet.mac_of(row, number).hex(":") for row in range(3)] for number, name in enumerate(radios)}
    assert links == {
        "car1": {"near": macs["near"][0], "far": macs["far"][0]},
        "car2": {"near": macs["near"][1], "far": macs["far"][1]},
        "car3": {"far": macs["far"][2]},
    }


@in_namespaces
async def test_a_single_radio_is_as_without_a_name() -> None:
    context = RunlessContext(("car1", "car2"), run=RUN, radios={"only": (0, 1)})
    async with open_gateway(Ip(), context):
        with udp("car1", "10.77.0.1") as sender, udp("car2", "10.77.0.2", 9000) as listener:
            sender.sendto(b"x", ("10.77.0.2", 9000))
            assert await next_datagram(listener) == (b"x", "10.77.0.1")
        _, output = await run_command("car1", "ip", "-br", "link", "show", "radio0")
    assert ethernet.mac_of(0).hex(":") in output


def test_addresses_of_radios_are_all_different() -> None:
    macs = [ethernet.mac_of(row, radio) for row in (0, 1, ethernet.VEHICLES - 1) for radio in (0, 1, ethernet.RADIOS - 1)]
    assert len({*macs}) == len(macs)
    stations = ethernet.Stations((0, 1), BROADCAST, 1)
    frame = ethernet.mac_of(1, 1) + ethernet.mac_of(0, 1) + b"\x08\x00" + bytes(46)
    assert stations.goes_to(0, frame) == 1
    assert stations.carries(0, frame)
    others = ethernet.Stations((0, 1), BROADCAST, 0)
    assert others.goes_to(0, frame) == ethernet.FOREIGN
    assert not others.carries(0, frame)


def test_networks_of_radios_follow_each_other_and_stay_private() -> None:
    first, first6 = network_of("10.77.0.0/16", "network", 4), network_of("fd77::/64", "network6", 6)
    assert [str(network_after(first, number)) for number in range(3)] == ["10.77.0.0/16", "10.78.0.0/16", "10.79.0.0/16"]
    assert [str(network_after(first6, number)) for number in range(2)] == ["fd77::/64", "fd77:0:0:1::/64"]
    with pytest.raises(ValueError, match=r"10\.255\.0\.0/16 has no 1 private networks"):
        network_after(network_of("10.255.0.0/16", "network", 4), 1)


@pytest.mark.parametrize(
    ("radios", "bridge", "message"),
    [
        ((), {"udp": {"radio": "far"}}, "bridge.udp.radio"),
        (("near", "far"), {"udp": {"radio": "lora"}}, "bridge.udp.radio: unknown radio 'lora'"),
        (("near", "far"), {"ip": {"layer": 3}}, "bridge.ip: layer: 3 needs one radio"),
        (("near", "long-range-radio"), {"ip": {}}, "an interface's name has at most 15 characters"),
        (("near", "port0"), {"ip": {}}, "no interface may be called port0"),
        (("near", "far"), {"ip": {"network": "10.255.0.0/16"}}, "bridge.ip: network: 10.255.0.0/16 has no 1 private"),
        (("near", "far"), {"ip": {"routes": {"car1": ["10.78.5.0/24"]}}}, "overlaps 10.78.0.0/16"),
    ],
)
def test_features_without_several_radios_give_one_error_line(
    radios: tuple[str, ...], bridge: dict[str, Any], message: str
) -> None:
    tables: Any = [{"name": name} for name in radios] or {}
    cars = [{"name": f"car{i}", "position": [float(i), 0.0, 0.0]} for i in (1, 2)]
    with pytest.raises(ScenarioError) as caught:
        check(scenario(radio=tables, vehicle=cars, bridge=bridge))
    assert message in str(caught.value)
