"""A routing program on the vehicles, with the commands of the page: routes, what crosses five hops, and the repair."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.cosim.run_processes import UNDRAWN
from tests.support.docs.readme_pages import PAGES, block
from vcmvsp.netsim.bridge.gateways.ip import run_networks

pytestmark = [
    pytest.mark.processes,
    pytest.mark.slow,
    pytest.mark.needs("babeld", "ip", "iperf3", "ping"),
    pytest.mark.usefixtures("namespaces_allowed"),
]

PAGE = "netsim/bridge/README.md"
NAME = f"chain{os.getpid()}"
CARS = ("car1", "car2", "car3", "car4", "car5", "car6", "relief")
READY_S, ROUTES_S, REPAIR_S = 40.0, 60.0, 120.0
LOSS, HOPS = 0.02, 5


def command(words: str) -> str:
    """The command of the page in which these words stand, for this run; it is given as root."""
    (line,) = [line for line in block(PAGE, "sudo sh babel.sh").splitlines() if words in line]
    return line.partition("  ")[0].removeprefix("sudo ")


class Chain:
    """The run of the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.began_s = 0.0

    def call(self, command: str, *, check: bool = True) -> str:
        """Output of a command of the page."""
        words = command.replace("vcmvsp net exec", f"vcmvsp net exec --run {NAME}")
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        done = subprocess.run(
            ["sh", "-ec", words],
            cwd=self.folder,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == 0 or not check, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    @property
    def time_s(self) -> float:
        """Time of the run, a little less than exact: it keeps to the wall clock."""
        return time.monotonic() - self.began_s

    def until(self, holds: Callable[[], bool], latest_s: float) -> None:
        while not holds():
            assert self.time_s < latest_s, f"not within {latest_s} s of the run"
            time.sleep(0.5)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("chain")
    (folder / "chain.toml").write_text(block(PAGE, 'name = "chain"').replace('"chain"', f'"{NAME}"'))
    (folder / "babel.sh").write_text(block(PAGE, "babeld -w").replace("vcmvsp-chain", f"vcmvsp-{NAME}"))
    made = Chain(folder)
    start = [sys.executable, *UNDRAWN, "net", "up", "chain.toml", "--out", "out"]
    with subprocess.Popen(start, cwd=folder, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        try:
            assert run.stderr is not None
            for line in run.stderr:
                if "vcmvsp net exec car1" in line:
                    break
            made.began_s = time.monotonic()
            routers = subprocess.Popen(command("sh babel.sh").split(), cwd=folder, start_new_session=True)
            try:
                yield made
            finally:
                os.killpg(routers.pid, signal.SIGINT)
                routers.wait(READY_S)
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=READY_S)
        finally:
            run.kill()
            with contextlib.suppress(run_networks.RunAlive):
                run_networks.clear(NAME)


def next_hop(chain: Chain, car: str, to: str) -> str:
    """The vehicle to which a vehicle sends packets for an address; empty: no route."""
    routes = chain.call(command("ip route").replace("car1", car))
    found = re.search(rf"^{re.escape(to)} via 10\.77\.0\.(\d+) ", routes, re.MULTILINE)
    return CARS[int(found[1]) - 1] if found else ""


def test_routes_over_five_hops_carry_everything_and_are_repaired(chain: Chain) -> None:
    """Delivery is (1 - loss)^hops within 3 %, as the page says; the deviation of 1000 datagrams is 1 %."""
    both = (("car1", "10.77.0.6"), ("car6", "10.77.0.1"))
    chain.until(lambda: all(next_hop(chain, *each) for each in both), ROUTES_S)
    assert [next_hop(chain, car, "10.77.0.6") for car in CARS[:5]] == ["car2", "car3", "car4", "car5", "car6"]
    said = chain.call(command(" ping "), check=False)
    assert "ttl=60" in said
    assert int(re.search(r"(\d+) received", said)[1]) >= 8  # type: ignore[index]  # of 20, with 0.98^10 = 0.82
    chain.call(command("iperf3 -s"))
    told = json.loads(chain.call(f"{command('iperf3 -c')} -t 10 --json"))["end"]["sum"]
    assert told["packets"] == pytest.approx(1000, rel=0.05)
    assert 1.0 - told["lost_packets"] / told["packets"] == pytest.approx((1.0 - LOSS) ** HOPS, abs=0.03)
    chain.until(lambda: chain.time_s > 41.0, 50.0)  # now car3 is out of range
    chain.until(lambda: next_hop(chain, "car2", "10.77.0.6") == next_hop(chain, "car4", "10.77.0.1") == "relief", REPAIR_S)
    said = chain.call(command(" ping "), check=False)
    assert "ttl=60" in said
    assert int(re.search(r"(\d+) received", said)[1]) >= 8  # type: ignore[index]


def test_the_page_says_which_losses_there_are() -> None:
    assert f"probability = {LOSS}" in block(PAGE, 'name = "chain"')
    assert f"0.98^{HOPS} = {0.98**HOPS:.2f}" in PAGES[PAGE]
