"""`vcmvsp net`: a run whose vehicles are network namespaces, programs in them, and remains of killed runs."""

import contextlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.support.cosim.command_line import assert_refused, vcmvsp_command
from tests.support.cosim.run_processes import VCMVSP
from vcmvsp.netsim.bridge.gateways.ip import namespaces
from vcmvsp.netsim.bridge.gateways.ip import run_networks as networks

NAME = f"net{os.getpid()}"
SCENARIO = """
name = "{name}"
duration_s = 3600
physics.kind = "kinematic"
radio.preset = "ideal"
radio.delay.seconds = 0.02
vehicles.kind = "p2dx"
[[vehicle]]
name = "car1"
[[vehicle]]
name = "car2"
pose = [1.0, 0.0, 0.0]
"""
READY_S = 40.0

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("namespaces_allowed")]


def net(*arguments: str) -> list[str]:
    return [*VCMVSP, "net", *arguments]


def on(vehicle: str, *command: str, run: str, text: str = "") -> "subprocess.CompletedProcess[str]":
    """Result of a program in a vehicle's namespace."""
    whole = net("exec", vehicle, "--run", run, "--", *command)
    return subprocess.run(whole, input=text, capture_output=True, text=True, check=False, timeout=500)


@contextlib.contextmanager
def up(folder: Path, *options: str, name: str = NAME) -> Iterator["subprocess.Popen[str]"]:
    """A run with a network; killed at the end if it is still running."""
    scenario = folder / f"{name}.toml"
    scenario.write_text(SCENARIO.format(name=name))
    command = [*VCMVSP, "net", "up", str(scenario), "--out", str(folder / name), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert process.stderr is not None
            lines = []
            for line in process.stderr:
                lines.append(line)
                if "vcmvsp net exec car1 -- ping car2" in line:
                    break
            else:
                raise AssertionError("".join(lines))
            yield process
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=READY_S)
        finally:
            process.kill()
            with contextlib.suppress(networks.RunAlive):  # a bridge that is still running removes its network itself
                networks.clear(name)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with up(tmp_path_factory.mktemp("up")):
        yield NAME


def test_names_of_vehicles_resolve_inside_and_others_still_do(network: str) -> None:
    usual = Path("/etc/hosts").read_text("utf-8")
    hosts_text = on("car1", "cat", "/etc/hosts", run=network).stdout
    assert hosts_text.startswith(usual.rstrip("\n"))
    for line in ("10.77.0.1\tcar1", "fd77::1\tcar1", "10.77.0.2\tcar2", "fd77::2\tcar2"):
        assert line in hosts_text.splitlines()
    text = "import socket; print(*sorted({each[4][0] for each in socket.getaddrinfo('car2', 80)}))"
    assert on("car1", sys.executable, "-c", text, run=network).stdout == "10.77.0.2 fd77::2\n"
    assert Path("/etc/hosts").read_text("utf-8") == usual


def test_a_program_has_its_own_input_output_and_exit_code(network: str) -> None:
    process = on("car1", "sh", "-c", "cat; echo trouble >&2; exit 7", run=network, text="as it is\n")
    assert (process.returncode, process.stdout, process.stderr) == (7, "as it is\n", "trouble\n")


def test_a_program_sees_the_interfaces_of_its_machine_alone(network: str) -> None:
    assert on("car2", "ls", "/sys/class/net", run=network).stdout.split() == ["lo", "radio0"]


def test_signals_go_to_the_program(network: str) -> None:
    text = "import time; print('here', flush=True); time.sleep(60)"
    with subprocess.Popen(
        net("exec", "car1", "--run", network, "--", sys.executable, "-c", text), stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "here\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(READY_S) == -signal.SIGTERM


def test_a_pipe_that_ends_ends_the_program(network: str) -> None:
    """Python ignores SIGPIPE; a program that inherited this would never end."""
    process = on("car1", "sh", "-c", "yes | head -1", run=network)
    assert (process.stdout, process.stderr) == ("y\n", "")


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("car9",), "car9: run {run} has no namespace for this vehicle; vehicles: car1, car2\n"),
        (("car1", "--run", "elsewhere"), r"--run elsewhere: no such run; runs: (\w+, )*{run}(, \w+)*\n"),
    ],
)
def test_an_unknown_vehicle_or_run_is_refused_with_the_known_ones(
    network: str, arguments: tuple[str, ...], problem: str
) -> None:
    outcome = vcmvsp_command("net", "exec", *arguments, *(() if "--run" in arguments else ("--run", network)), "--", "true")
    assert_refused(outcome)
    assert re.fullmatch(f"vcmvsp: {problem.format(run=network)}", outcome.err)


def test_a_missing_program_is_reported_in_one_line(network: str) -> None:
    process = on("car1", "no-such-program", "-x", run=network)
    assert (process.returncode, process.stdout) == (2, "")
    assert process.stderr == "vcmvsp: no-such-program -x: No such file or directory\n"


def test_of_two_runs_one_must_be_named(network: str) -> None:
    other = networks.Lease(f"{NAME}other")
    try:
        outcome = vcmvsp_command("net", "exec", "car1", "--", "true")
    finally:
        other.end()
    assert_refused(outcome, "several runs: add --run with one of")
    assert {NAME, f"{NAME}other"} <= set(re.findall(r"\w+", outcome.err))


def test_status_shows_addresses_and_a_live_run(network: str) -> None:
    outcome = vcmvsp_command("net", "status", "--json")
    about = next(each for each in json.loads(outcome.out) if each["run"] == network)
    assert about["alive"] is True
    addresses = {each["vehicle"]: each["addresses"] for each in about["spaces"]}
    assert addresses == {"car1": ["10.77.0.1", "fd77::1"], "car2": ["10.77.0.2", "fd77::2"]}
    text = vcmvsp_command("net", "status").out
    assert f"{network}: alive, process {about['pid']}\n  car1  10.77.0.1  fd77::1\n  car2  10.77.0.2  fd77::2\n" in text


def test_the_network_of_a_live_run_is_not_removed(network: str) -> None:
    assert_refused(vcmvsp_command("net", "down", network), f"run {network} is alive")
    assert on("car1", "true", run=network).returncode == 0


def test_a_second_run_of_the_same_name_is_refused_before_it_begins(network: str, tmp_path: Path) -> None:
    scenario = tmp_path / "again.toml"
    scenario.write_text(SCENARIO.format(name=network))
    outcome = vcmvsp_command("net", "up", str(scenario), "--out", str(tmp_path / "out"))
    assert_refused(outcome, f"a run named {network} already has a network on this machine")
    assert not (tmp_path / "out").exists()


def test_without_a_name_all_dead_networks_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "FOLDER", tmp_path / "net")
    assert vcmvsp_command("net", "status").out == "no run has a network on this machine\n"
    assert vcmvsp_command("net", "down").out == "no network to remove\n"
    leases = {name: networks.Lease(name) for name in ("alive", "dead")}
    for name, lease in leases.items():
        lease.tell(networks.RunNetwork(run=name, pid=os.getpid(), spaces=()))
    os.close(leases["dead"]._lock)  # as at the end of its process
    assert vcmvsp_command("net", "down").out == "dead: gone\n"
    assert [each.run for each in networks.networks()] == ["alive"]
    leases["alive"].end()
    assert not networks.networks()


@pytest.mark.needs("ping")
def test_ping_agrees_with_the_recorded_radio(tmp_path: Path) -> None:
    name = f"{NAME}ping"
    with up(tmp_path, "--set", "radio.loss.probability=0.25", "--set", "bridge.ip.layer=3", name=name):  # no ARP among the rows
        # 20 one by one, on an idle radio; then 80 at once: after these, ping waits for the time given by -W, not for two
        # round-trip times.
        pings = "ping -n -c 20 -i 0.03 -W 1 car2; ping -n -c 80 -l 80 -W 2 car2"
        output = on("car1", "sh", "-c", pings, run=name).stdout
    rows = pq.read_table(tmp_path / name / "radio.parquet").to_pylist()
    there = [each["outcome"] == "received" for each in rows if each["sender"] == "car1"]
    back = [each["outcome"] == "received" for each in rows if each["sender"] == "car2"]
    assert len(there) == 20 + 80
    assert len(back) == sum(there) < len(there)  # car2 answers every request that it receives
    assert f"80 packets transmitted, {sum(back[sum(there[:20]) :])} received" in output
    quickest_ms = [float(each) for each in re.findall(r"min/avg/max/mdev = ([\d.]+)", output)]
    assert 40.0 <= min(quickest_ms) < 80.0  # 20 ms each way


def measured_bps(name: str, size: int) -> float:
    """Rate that iperf3 measures at car2, bit/s; the median is robust against short stalls of the machine."""
    command = net("exec", "car2", "--run", name, "--", "iperf3", "-s", "-1", "-J", "-i", "0.25", "--forceflush")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        end = time.monotonic() + READY_S
        while ":1451 " not in on("car2", "cat", "/proc/net/tcp6", "/proc/net/tcp", run=name).stdout:  # its port, 5201
            assert time.monotonic() < end
        client = on("car1", "iperf3", "-c", "10.77.0.2", "-u", "-b", "5M", "-l", str(size), "-t", "3", run=name)
        if client.returncode:
            server.kill()  # it waits for a client whose greeting was lost
            return 0.0
        report, _ = server.communicate(timeout=READY_S)
    sums = [each["sum"] for each in json.loads(report)["intervals"]][2:]
    rates = [each["bits_per_second"] for each in sums if each["seconds"] > 0.2]  # a shorter one is the last, or follows a stall
    return statistics.median(rates) if len(rates) > 4 else 0.0


@pytest.mark.needs("iperf3")
def test_iperf_measures_the_rate_of_the_link(tmp_path: Path) -> None:
    """Of three measurements, one is enough: a machine that stands still for seconds spoils the others."""
    name, rate_bps, size = f"{NAME}rate", 4e6, 1400
    expected = pytest.approx(rate_bps * size / (size + 28), rel=0.03)  # without headers of UDP and IP
    limits = ("--set", f"radio.delivery.rate_bps={rate_bps:g}", "--set", "radio.delivery.queue_s=0.1")
    with up(tmp_path, *limits, name=name):
        found = measured_bps(name, size)
        for _ in range(2):
            found = found if found == expected else measured_bps(name, size)
    assert found == expected


def assert_nothing_left(name: str) -> None:
    """A run has no network and no namespaces."""
    assert not [each for each in networks.networks() if each.run == name]
    assert not list(namespaces.NAMES.glob(f"vcmvsp-{name}-*"))


@pytest.mark.parametrize("gateway", ["ip", "lab"])
def test_a_network_lasts_for_its_duration_and_leaves_nothing(tmp_path: Path, gateway: str) -> None:
    """A gateway of another name is the network, too: a second gateway of this kind would be refused."""
    name = f"{NAME}{gateway}"
    options = ("--set", f"bridge.{gateway}.kind=ip", "--network", "10.99.0.0/24", "--duration", "0.5")
    with up(tmp_path, *(options if gateway == "lab" else options[2:]), name=name) as process:
        assert process.wait(READY_S) == 0
        assert_nothing_left(name)
    scenario = (tmp_path / name / "scenario.toml").read_text()
    assert re.findall(r"^\[bridge\.(\w+)\]$", scenario, re.MULTILINE) == [gateway]
    assert 'network = "10.99.0.0/24"' in scenario


def test_remains_of_a_killed_run_are_shown_and_removed(tmp_path: Path) -> None:
    name = f"{NAME}killed"
    with up(tmp_path, name=name) as process:
        bridge = next(each.pid for each in networks.networks() if each.run == name)
        for each in (process.pid, bridge):
            os.kill(each, signal.SIGKILL)
        process.wait(READY_S)
        end = time.monotonic() + READY_S
        while any(each.alive for each in networks.networks() if each.run == name):
            assert time.monotonic() < end
        assert f"{name}: killed; remove it with 'vcmvsp net down'" in vcmvsp_command("net", "status").out
        assert len(list(namespaces.NAMES.glob(f"vcmvsp-{name}-*"))) == 2
        assert f"{name}: gone" in vcmvsp_command("net", "down", name).out
        assert vcmvsp_command("net", "down", name).out == "no network to remove\n"
        assert_nothing_left(name)


def test_force_removes_the_network_of_a_live_run(tmp_path: Path) -> None:
    name = f"{NAME}forced"
    with up(tmp_path, name=name) as process:
        assert vcmvsp_command("net", "down", name, "--force").code == 0
        assert process.wait(READY_S) == 3
        assert_nothing_left(name)


def test_missing_rights_are_named(tmp_path: Path) -> None:
    scenario = tmp_path / "cars.toml"
    scenario.write_text(SCENARIO.format(name=f"{NAME}powerless"))
    without = "import ctypes, os, sys; ctypes.CDLL(None).prctl(24, 12); os.execv(sys.argv[1], sys.argv[1:])"  # PR_CAPBSET_DROP
    for arguments in (("up", str(scenario)), ("exec", "car1", "--", "true"), ("down",)):
        process = subprocess.run(
            [sys.executable, "-c", without, *net(*arguments)], capture_output=True, text=True, check=False, cwd=tmp_path
        )
        assert (process.returncode, process.stdout) == (2, "")
        assert process.stderr.startswith("vcmvsp: network namespaces need CAP_NET_ADMIN: ")
        assert process.stderr.count("\n") == 1
    assert not (tmp_path / "runs").exists()


CALLED_BY_SUDO = """
import os
from vcmvsp.cosim.assembly.parts import networks
from vcmvsp.netsim.bridge import messages
from vcmvsp.netsim.bridge.process_client import BridgeClient
networks.leave_root()
print(os.getresuid() + os.getresgid(), os.getgroups())
try:
    os.setuid(0)
except PermissionError:
    print("for good")
gateway = messages.GatewaySpec(name="ip", kind={kind!r}, params={{}})
vehicles = ("car1", "car2")
gateways = (gateway,)
opening = messages.Opening(run={run!r}, folder={folder!r}, vehicles=vehicles, gateways=gateways, payloads=False)
beside = BridgeClient.start(opening)
try:
    print(beside.wait_ready()[0])
except Exception as error:
    print(error)
else:
    beside.leave()
finally:
    beside.close()
"""


def called_by_sudo(run: str, kind: str, folder: Path) -> list[str]:
    """Output of a program started with sudo by user nobody (65534): its ids, and the answer of the bridge that it starts."""
    code = CALLED_BY_SUDO.format(run=run, kind=kind, folder=str(folder))
    environment = {**os.environ, "SUDO_UID": "65534"}
    process = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    return process.stdout.splitlines()


def test_with_sudo_only_the_interfaces_are_made_as_root(tmp_path: Path) -> None:
    ids, for_good, line = called_by_sudo(f"{NAME}sudo", "ip", tmp_path)
    assert (ids, for_good) == (f"{(65534,) * 6} [65534]", "for good")
    assert "10.77.0.1" in line
    assert not (namespaces.NAMES / f"vcmvsp-{NAME}sudo-car1").exists()


@pytest.mark.parametrize(
    ("run", "kind"), [(NAME, "evil.py:Door"), (NAME, "os:system"), ("../evil", "ip")], ids=["a file", "a module", "a path"]
)
def test_with_sudo_a_run_passes_no_code_and_no_files_to_root(run: str, kind: str, tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    (tmp_path / "evil.py").write_text(f"open({str(canary)!r}, 'w')\nclass Door: pass\n")
    *_, problem = called_by_sudo(run, kind, tmp_path)
    assert "only built-in gateways" in problem or "not a valid network name" in problem
    assert not canary.exists()


def test_with_sudo_programs_run_as_the_calling_user(network: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUDO_UID", "65534")
    assert on("car1", "id", "-u", run=network).stdout == "65534\n"
