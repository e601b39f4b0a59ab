"""The bridge at wall pace: how late datagrams leave, and how many it carries. ``python -m bench.bridge``, within a minute.

Each row is a run of its own in a process of its own, with the bridge process beside it, both on one core where the row says so;
who sends and who hears are two more processes on the other. A datagram that neither the emulated radio lost nor a program had
no room for must arrive: what is missing beyond that is counted.
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

SIZE = 100  # bytes
READY_S = 30.0
HEAR = 99  # of a vehicle's hundred ports: where its program hears
RATES = (20_000, 40_000)  # datagrams/s: one that is to be carried, one beyond the limit


class Load(NamedTuple):
    """One run."""

    name: str
    rate: int  # datagrams/s
    seconds: float
    delay: dict[str, Any]
    one_core: bool


class Carried(NamedTuple):
    """What became of it."""

    sent: int
    heard: int
    about: dict[str, Any]  # about.json: bridge
    run_us: float  # CPU time per datagram
    process_us: float

    @property
    def missing(self) -> int:
        """What was sent and not heard, though nobody has counted it."""
        counted = sum(sum(each.values()) for each in self.about["counts"].values())
        return self.sent - self.heard - counted


def main() -> int:
    """Print the table; the exit code says whether all demands hold."""
    if len(os.sched_getaffinity(0)) < 2:
        print("needs two cores")
        return 2
    fixed, spread = {"seconds": 0.02}, {"seconds": 0.02, "jitter_s": 0.01}
    delayed = [
        Load("20 ms", 1_000, 6.0, fixed, one_core=False),
        Load("20 ms, jitter 10 ms", 1_000, 6.0, spread, one_core=False),
    ]
    limits = [Load("ideal, one core", rate, 5.0, {}, one_core=True) for rate in RATES]
    print("| channel | datagrams/s | late by p50 | p99 | heard | counted drops | missing | us/datagram run + process | |")
    print("|---|---|---|---|---|---|---|---|---|")
    good = True
    for load in (*delayed, *limits):
        carried = _carried(load)
        on_time = carried.about["p50_s"] <= 0.3e-3 and carried.about["p99_s"] <= 2e-3
        whole = carried.heard == carried.sent
        holds = carried.missing == 0 and (load.one_core or on_time) and (load.rate > RATES[0] or whole)
        good &= holds
        print(_row(load, carried, holds), flush=True)
    return 0 if good else 1


def _row(load: Load, carried: Carried, holds: bool) -> str:
    p50, p99 = (f"{1e3 * carried.about[key]:.2f} ms" for key in ("p50_s", "p99_s"))
    cells = [
        load.name,
        load.rate,
        p50,
        p99,
        f"{carried.heard} of {carried.sent}",
        carried.sent - carried.heard - carried.missing,
        carried.missing,
        f"{carried.run_us:.0f} + {carried.process_us:.0f}",
        "holds" if holds else "FAILS",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def _carried(load: Load) -> Carried:
    cores = sorted(os.sched_getaffinity(0))
    first_port = _free_ports()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        given = {"first_port": first_port, "delay": load.delay, "seconds": load.seconds + 4.0, "out": str(out)}
        run = _started("run", json.dumps(given), on=cores[:1] if load.one_core else cores)
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
        heard = int(hearing.communicate()[0])
        about = json.loads((out / "about.json").read_text())["bridge"]
    return Carried(sent, heard, about, 1e6 * run_s / about["datagrams"], 1e6 * process_s / about["datagrams"])


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
    """Until somebody has it."""
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


def run(given: str) -> None:
    """Two vehicles that stand, at wall pace."""
    import cosim

    wanted = json.loads(given)
    vehicle = {"kind": "kinematic"}
    scenario = {
        "name": "bridge-bench",
        "duration_s": wanted["seconds"],
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "ideal", "delay": wanted["delay"] or {"kind": "none"}},
        "vehicle": [{"name": "a", **vehicle}, {"name": "b", "position": [5.0, 0.0, 0.0], **vehicle}],
        "bridge": {"udp": {"first_port": wanted["first_port"]}},
    }
    cosim.run(scenario, out=wanted["out"])


def hear(port: str) -> None:
    """Count what comes, until nothing has for a while."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.setsockopt(socket.SOL_SOCKET, 33, 64 * 2**20)  # SO_RCVBUFFORCE
        heard.bind(("127.0.0.1", int(port)))
        print("ready", flush=True)
        heard.settimeout(READY_S)
        count = 0
        try:
            while True:
                heard.recv(SIZE)
                count += 1
                if count == 1:
                    heard.settimeout(4.0)
        except TimeoutError:
            print(count)


def send(port: str, rate: str, seconds: str) -> None:
    """Send steadily; prints how many."""
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
        parts: dict[str, Callable[..., None]] = {"run": run, "hear": hear, "send": send}
        parts[sys.argv[1]](*sys.argv[2:])
    else:
        sys.exit(main())
