"""Driver of real Crazyflies on a simulated one, through cflib."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.hardware.driver_runs import eventually, fly, newest, open_driver
from tests.support.paths import ROOT
from vcmvsp.hardware.drivers.base import Driver, HandshakeError, LinkLost
from vcmvsp.hardware.drivers.crazyflie import CrazyflieDriver

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SCENARIO = """
name = "one"
duration_s = 60.0
[physics]
kind = "bullet"
rate_hz = 250.0
[agents]
period_s = 0.02
on_lost = "hold"
[stack.crazyflie]
vehicles = ["cf1"]
first_port = {port}
[[vehicle]]
name = "cf1"
kind = "crazyflie"
"""


@pytest.fixture
def run(port: int, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Process of a run with one reachable aircraft."""
    scenario = tmp_path / "one.toml"
    scenario.write_text(SCENARIO.format(port=port))
    words = [sys.executable, "-m", "vcmvsp.cosim.cli.app", "run", str(scenario), "--out", str(tmp_path / "run")]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        while "reach" not in process.stderr.readline():
            assert process.poll() is None
        yield process
        process.kill()


def test_it_takes_off_flies_and_lands(run: subprocess.Popen[str], port: int) -> None:
    with open_driver(CrazyflieDriver(uri=f"udp://127.0.0.1:{port}", takeoff_m=0.3, origin=(1.0, 2.0, 0.0))) as driver:
        assert isinstance(driver, Driver)
        eventually(lambda: newest(driver).state.position == pytest.approx((1.0, 2.0, 0.3), abs=0.05))
        samples = fly(driver, 1.2, 0.3, 0.1, 0.0)
        x, y, z = samples[-1].state.position
        assert x - 1.0 == pytest.approx(3.0 * (y - 2.0), rel=0.1)
        assert 0.2 < x - 1.0 < 0.5
        assert z == pytest.approx(0.3, abs=0.1)  # set points come late from a process that stands still
        assert samples[-1].state.velocity == pytest.approx((0.3, 0.1, 0.0), abs=0.05)
        driver.stop("geofence")
        eventually(lambda: abs(newest(driver).state.velocity[0]) < 0.02)
    with open_driver(CrazyflieDriver(uri=f"udp://127.0.0.1:{port}", origin=(1.0, 2.0, 0.0))) as driver:
        assert newest(driver).state.position[2] < 0.05  # landed on close
        run.kill()
        with pytest.raises(LinkLost):
            eventually(lambda: driver.read() and False, 120.0)


def test_no_aircraft(port: int) -> None:
    driver = CrazyflieDriver(uri=f"udp://127.0.0.1:{port}", connect_s=1.0)
    with pytest.raises(HandshakeError, match="check its battery"):
        driver.open()
    with pytest.raises(HandshakeError, match="No driver found"):
        CrazyflieDriver(uri="nonsense", connect_s=1.0).open()
