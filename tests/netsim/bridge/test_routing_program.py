"""Routing programs on the vehicles, with the commands of the page: routes, delivery over five hops, and repair."""

import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from itertools import pairwise
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.support.docs.readme_pages import PAGES, block
from tests.support.netsim.vehicle_namespaces import network_up

pytestmark = [
    pytest.mark.processes,
    pytest.mark.slow,
    pytest.mark.needs("babeld", "bird", "ip", "iperf3", "ping"),
    pytest.mark.usefixtures("namespaces_allowed"),
]

PAGE = "netsim/bridge/README.md"
SOONER = (  # hellos, and so routes, in half the time; car3 and relief begin half as far from the ends of their links
    ("-h 1", "-h 0.5"),
    ("hello interval 1 s", "hello interval 500 ms"),
    ("120.0, -15.0", "120.0, -38.0"),
    ("120.0, 98.0", "120.0, 79.0"),
)
PROGRAMS = {"babel": "babeld -w", "bird": "bird -f"}  # parts of their command lines
CARS = ("car1", "car2", "car3", "car4", "car5", "car6", "relief")
ASK_EVERY_S, READY_S, ROUTES_S, REPAIR_S, DELIVERY_S = 1.0, 40.0, 60.0, 300.0, 240.0
LOSS, HOPS = 0.02, 5
DATAGRAM_BYTES = 228  # with the headers of UDP and IPv4


def command(words: str) -> str:
    """Command of the page that contains these words; it runs as root."""
    (line,) = [line for line in block(PAGE, "sudo sh babel.sh").splitlines() if words in line]
    return line.partition("  ")[0].removeprefix("sudo ")


class Chain:
    """The page's run, with a routing program."""

    def __init__(self, folder: Path, program: str) -> None:
        self.folder, self.name = folder, f"{program}{os.getpid()}"
        self.began_s = 0.0
        texts = {
            "chain.toml": block(PAGE, 'name = "chain"').replace('"chain"', f'"{self.name}"'),
            "route.sh": block(PAGE, PROGRAMS[program]).replace("vcmvsp-chain", f"vcmvsp-{self.name}"),
            "bird.conf": block(PAGE, "protocol babel"),
        }
        for name, text in texts.items():
            (folder / name).write_text(reduce(lambda read, change: read.replace(*change), SOONER, text))

    def call(self, command: str, *, check: bool = True) -> str:
        """Output of a command of the page."""
        line = command.replace("vcmvsp net exec", f"vcmvsp net exec --run {self.name}")
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        result = subprocess.run(
            ["sh", "-ec", line],
            cwd=self.folder,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert result.returncode == 0 or not check, f"{command}: {result.stdout}{result.stderr}"
        return result.stdout

    @property
    def time_s(self) -> float:
        """Run time, s, slightly late: the run keeps to the wall clock."""
        return time.monotonic() - self.began_s

    def until(self, holds: Callable[[], bool], latest_s: float) -> None:
        while not holds():
            assert self.time_s < latest_s, f"not within {latest_s} s of the run"
            time.sleep(ASK_EVERY_S)


@contextlib.contextmanager
def running(folder: Path, program: str) -> Iterator[Chain]:
    """The page's run, while the program routes."""
    folder.mkdir()
    made = Chain(folder, program)
    with network_up(folder / "chain.toml", made.name):
        made.began_s = time.monotonic()
        with subprocess.Popen(["sh", "route.sh"], cwd=folder, start_new_session=True) as routers:
            try:
                yield made
            finally:
                os.killpg(routers.pid, signal.SIGINT)
                routers.wait(READY_S)


def next_hop(chain: Chain, car: str, to: str) -> str:
    """Next hop of a vehicle for an address; empty: no route."""
    routes = chain.call(command("ip route").replace("car1", car))
    found = re.search(rf"^{re.escape(to)} via 10\.77\.0\.(\d+) ", routes, re.MULTILINE)
    return CARS[int(found[1]) - 1] if found else ""


def routed(folder: Path, program: str) -> None:
    with running(folder / program, program) as chain:
        check_routes(chain)


def check_routes(chain: Chain) -> None:
    """Repeats a failed check: a machine with other work delays the program's hellos, so that links seem worse than they are."""
    both = (("car1", "10.77.0.6"), ("car6", "10.77.0.1"))
    chain.until(lambda: all(next_hop(chain, *each) for each in both), ROUTES_S)
    hops = list(pairwise(("car1", "car2", "relief", "car4", "car5", "car6")))  # after car3 is out of range
    chain.until(lambda: all(next_hop(chain, car, "10.77.0.6") == to for car, to in hops), REPAIR_S)
    chain.until(lambda: answers(chain) >= 8, REPAIR_S)  # of 20, with 0.98^10 = 0.82
    chain.until(lambda: share_delivered(chain) > 0.5, DELIVERY_S)  # with 0.98^5 = 0.90: 2375 receptions at least


def answers(chain: Chain) -> int:
    """Replies to 20 requests over all hops, forwarded by four vehicles."""
    output = chain.call(command(" ping "), check=False)
    found = re.search(r"(\d+) received", output)
    return int(found[1]) if found and "ttl=60" in output else 0


def share_delivered(chain: Chain) -> float:
    """Share of 1000 datagrams that arrive over all hops; 0: the programs did not meet."""
    chain.call(command("iperf3 -s"), check=False)
    output = chain.call(f"{command('iperf3 -4')} -t 10 --json", check=False)
    totals = json.loads(output)["end"].get("sum") if output else None
    if not totals or totals["packets"] < 950:
        return 0.0
    return 1.0 - float(totals["lost_packets"]) / float(totals["packets"])


def check_losses(folder: Path) -> None:
    """The outcome "random loss" has its share among lost and received datagrams, over all links."""
    rows = pq.read_table(folder / "out" / "radio.parquet", filters=[("size_bytes", "==", DATAGRAM_BYTES)])
    outcomes = Counter(rows["outcome"].to_pylist())
    lost, received = outcomes["random loss"], outcomes["received"]
    assert received > 2000, outcomes
    deviation = math.sqrt(LOSS * (1.0 - LOSS) / (lost + received))
    assert lost / (lost + received) == pytest.approx(LOSS, abs=7.0 * deviation)  # each run has other frames: less than 1e-9


def test_routes_over_five_hops_carry_datagrams_and_are_repaired(tmp_path: Path) -> None:
    """Each link loses its share of datagrams to the next hop; the number that cross all links in time depends on the machine's
    load.

    The programs have runs of their own, in parallel, because each run lasts a minute of wall-clock time.
    """
    with ThreadPoolExecutor() as pool:
        list(pool.map(partial(routed, tmp_path), PROGRAMS))
    for program in PROGRAMS:
        check_losses(tmp_path / program)


def test_the_page_lists_the_losses() -> None:
    assert f"probability = {LOSS}" in block(PAGE, 'name = "chain"')
    assert f"0.98^{HOPS} = {0.98**HOPS:.2f}" in PAGES[PAGE]
