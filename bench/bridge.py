"""The bridge at wall pace: lateness and capacity for datagrams. ``python -m bench.bridge``, within a minute.

Each row is a run in a process of its own, with the bridge process beside it, both on one core where the row says so; sender
and receiver are two more processes on the other. A datagram that is not lost on the emulated radio and has room in the
program's socket must arrive: the rest is counted as missing.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from bench.measure import Row, measured, table

SIZE = 100  # bytes
READY_S = 30.0
HEAR = 99  # port, within a vehicle's hundred, on which its program receives
RATES = (20_000, 40_000)  # datagrams/s: a rate to be carried, and one beyond the limit


class Load(NamedTuple):
    """One run."""

    name: str
    rate: int  # datagrams/s
    seconds: float
    delay: dict[str, Any]
    one_core: bool


class Carried(NamedTuple):
    """Result of one run."""

    sent: int
    received: int
    about: dict[str, Any]  # about.json: bridge
    run_us: float  # CPU time per datagram
    process_us: float

    @property
    def missing(self) -> int:
        """Datagrams sent and not received, without being counted anywhere."""
        counted = sum(sum(each.values()) for each in self.about["counts"].values())
        return self.sent - self.received - counted


def rows() -> list[Row]:
    """Lateness and capacity, beside a bare relay, which forwards datagrams from one socket to another."""
    return measured([delayed, jittered, much, too_much])


def delayed() -> Row:
    """Constant delay, at a rate at which it can be kept."""
    return _on_time(Load("delay 20 ms", 1_000, 6.0, {"seconds": 0.02}, one_core=False))


def jittered() -> Row:
    """Constant delay with jitter."""
    return _on_time(Load("delay 20 ms, jitter 10 ms", 1_000, 6.0, {"seconds": 0.02, "jitter_s": 0.01}, one_core=False))


def much() -> Row:
    """The rate to be carried on one core."""
    load = Load("ideal, run and bridge on one core", RATES[0], 5.0, {}, one_core=True)
    return _whole(load, "goal: all arrive", lambda carried: carried.received == carried.sent)


def too_much() -> Row:
    """A rate beyond the limit: every loss is counted."""
    load = Load("ideal, run and bridge on one core", RATES[1], 5.0, {}, one_core=True)
    return _whole(load, "what does not arrive is counted", lambda carried: carried.missing == 0)


def _on_time(load: Load) -> Row:
    carried = _carried(load)
    p50_s, p99_s = carried.about["p50_s"], carried.about["p99_s"]
    ours = f"late by p50 {1e3 * p50_s:.2f} ms, p99 {1e3 * p99_s:.2f} ms"
    return _row(load, carried, ours, "goal: p50 <= 0.3 ms, p99 <= 2 ms", holds=p50_s <= 0.3e-3 and p99_s <= 2e-3)


def _whole(load: Load, demand: str, holds: Callable[[Carried], bool]) -> Row:
    carried = _carried(load)
    counted = carried.sent - carried.received - carried.missing
    ours = f"{carried.received} of {carried.sent} arrive, {counted} counted as dropped, {carried.missing} missing"
    return _row(load, carried, ours, demand, holds=holds(carried))


def _row(load: Load, carried: Carried, ours: str, demand: str, *, holds: bool) -> Row:
    bare_us = _bare_us(load)
    cost = f"{carried.run_us:.0f} + {carried.process_us:.0f} us CPU a datagram (run + bridge process)"
    ratio = (carried.run_us + carried.process_us) / bare_us
    name = f"bridge.udp, {load.name}, {load.rate} datagrams/s"
    return Row(name, f"{ours}; {cost}", f"{bare_us:.0f} us CPU, a bare relay", ratio, demand, holds and carried.missing == 0)


def _bare_us(load: Load) -> float:
    """CPU time per datagram of a program that only forwards."""
    cores = sorted(os.sched_getaffinity(0))
    first = _free_ports()
    hearing = _started("hear", str(first + 1), on=cores[-1:])
    assert hearing.stdout is not None
    hearing.stdout.readline()
    relay = _started("relay", str(first), on=cores[:1])
    _wait_for_port(first)
    begin = _cpu_s(relay.pid)
    sent = int(_started("send", str(first), str(load.rate), "2.0", on=cores[-1:]).communicate()[0])
    cost_s = _cpu_s(relay.pid) - begin
    relay.kill()
    relay.communicate()
    hearing.communicate()
    return 1e6 * cost_s / sent


def _carried(load: Load) -> Carried:
    cores = sorted(os.sched_getaffinity(0))
    first_port = _free_ports()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        settings = {"first_port": first_port, "delay": load.delay, "seconds": load.seconds + 4.0, "out": str(out)}
        run = _started("run", json.dumps(settings), on=cores[:1] if load.one_core else cores)
        _wait_for_port(first_port)
        hearing = _started("hear", str(first_port + 100 + HEAR), on=cores[-1:])
        assert hearing.stdout is not None
        hearing.stdout.readline()
        time.sleep(0.5)
        pids = [run.pid, int(Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()[0])]
        before = [_cpu_s(pid) for pid in pids]
        sending = _started("send", str(first_port + 2), str(load.rate), str(load.seconds), on=cores[-1:])
        sent = int(sending.communicate()[0])
        time.sleep(1.0)
        run_s, process_s = (_cpu_s(pid) - earlier for pid, earlier in zip(pids, before, strict=True))
        run.communicate()
        received = int(hearing.communicate()[0])
        about = json.loads((out / "about.json").read_text())["bridge"]
    return Carried(sent, received, about, 1e6 * run_s / about["datagrams"], 1e6 * process_s / about["datagrams"])


def _cpu_s(pid: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _started(*arguments: str, on: list[int]) -> subprocess.Popen[str]:
    """A part of this program in a process of its own, on these cores."""
    started = subprocess.Popen([sys.executable, "-m", "bench.bridge", *arguments], stdout=subprocess.PIPE, text=True)
    os.sched_setaffinity(started.pid, on)  # before it has a child, which inherits that
    return started


def _free_ports() -> int:
    for first in range(30_000, 40_000, 200):
        try:
            for port in range(first, first + 200):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
                    tried.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first
    raise OSError("no free ports")


def _wait_for_port(port: int) -> None:
    """Wait until a program has bound a port."""
    until = time.monotonic() + READY_S
    while time.monotonic() < until:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
            try:
                tried.bind(("127.0.0.1", port))
            except OSError:
                return
        time.sleep(0.05)
    raise TimeoutError("the bridge has not opened its ports")


# The parts


def run(settings_json: str) -> None:
    """Two vehicles at rest, at wall pace."""
    import vcmvsp

    settings = json.loads(settings_json)
    vehicle = {"kind": "kinematic"}
    scenario = {
        "name": "bridge-bench",
        "duration_s": settings["seconds"],
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "ideal", "delay": settings["delay"] or {"kind": "none"}},
        "vehicle": [{"name": "a", **vehicle}, {"name": "b", "position": [5.0, 0.0, 0.0], **vehicle}],
        "bridge": {"udp": {"first_port": settings["first_port"]}},
    }
    vcmvsp.run(scenario, out=settings["out"])


def hear(port: str) -> None:
    """Count datagrams until none arrives for a while."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, 33, 64 * 2**20)  # SO_RCVBUFFORCE
        receiver.bind(("127.0.0.1", int(port)))
        print("ready", flush=True)
        receiver.settimeout(READY_S)
        count = 0
        try:
            while True:
                receiver.recv(SIZE)
                count += 1
                if count == 1:
                    receiver.settimeout(4.0)
        except TimeoutError:
            print(count)


def relay(port: str) -> None:
    """Forward datagrams to the next port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taking:
        taking.bind(("127.0.0.1", int(port)))
        following = "127.0.0.1", int(port) + 1
        while True:
            taking.sendto(taking.recv(SIZE), following)


def send(port: str, rate: str, seconds: str) -> None:
    """Send at a constant rate; prints the number sent."""
    count, period = round(float(rate) * float(seconds)), 1.0 / float(rate)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.connect(("127.0.0.1", int(port)))
        payload, begin = bytes(SIZE), time.monotonic()
        for number in range(count):
            sending.send(payload)
            if (ahead_s := begin + number * period - time.monotonic()) > 0.0002:
                time.sleep(ahead_s)
    print(count)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        parts: dict[str, Callable[..., None]] = {"run": run, "hear": hear, "relay": relay, "send": send}
        parts[sys.argv[1]](*sys.argv[2:])
    else:
        print(table(rows()))
