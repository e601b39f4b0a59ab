"""Cost of the radio: beside ns-3 on the same network, and for a thousand vehicles."""

import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from bench.measure import Row, in_turn, missing
from bench.ns3.cases import Case
from bench.ns3.program import Floats, MissingError, program

ROUNDS = 3
DURATION_S = 5.0  # of traffic

_OURS = """
import os, sys, time
os.environ["VCMVSP_COMPILED"] = sys.argv[1]
from bench.measure import peak_mib
from vcmvsp.cosim.cli.app import main
try:
    main(sys.argv[2:])
finally:
    print(time.process_time(), peak_mib())
"""


def rows() -> Iterator[Row]:
    """All rows; each is measured when it is requested."""
    for phy in ("b-1", "g-6"):
        yield _beside_ns3(phy, least=30.0)
    yield _real_time()
    yield from _thousand()


def _beside_ns3(phy: str, *, least: float) -> Row:
    """CPU of a network of 100 that all hear each other, 10 Hz, 100 bytes."""
    name, demand = f"802.11 {phy}, 100 nodes, 10 Hz, compiled; beside ns-3.44", f">= {least:g} times less"
    frames = 100 * 10 * DURATION_S
    try:
        ours, other, ratio = _hundred(phy)
    except MissingError as error:
        return missing(name, demand, error)
    our_cost, other_cost = f"{1e6 * ours / frames:.0f} us a frame", f"{1e6 * other / frames:.0f} us"
    return Row(name, our_cost, other_cost, ratio, demand, ratio <= 1.0 / least)


@functools.cache
def _hundred(phy: str) -> tuple[float, float, float]:
    """CPU seconds of both, and their ratio; two rows use one of the measurements."""
    print(f"measuring: radio, {phy}, beside ns-3 ...", file=sys.stderr, flush=True)
    program()  # before any other measurement
    case = Case(phy, 100, 10.0)
    return in_turn(partial(_ours_s, case, compiled=True), partial(_ns3_s, case), ROUNDS)


def _real_time() -> Row:
    name, demand = "the same, 802.11 b-1 compiled, as speed; beside ns-3.44", "goal: >= 20 sim s / CPU s"
    try:
        ours, other, ratio = _hundred("b-1")
    except MissingError as error:
        return missing(name, demand, error)
    speed = DURATION_S / ours
    return Row(name, f"{speed:.0f} sim s / CPU s", f"{DURATION_S / other:.1f}", ratio, demand, speed >= 20.0)


def _thousand() -> Iterator[Row]:
    """A thousand vehicles with shadowed levels; CPU time of the whole command, and its memory."""
    print("measuring: radio, a thousand ...", file=sys.stderr, flush=True)
    case = Case("b-1", 1000, 10.0, side_m=500.0)
    settings = ["mac.kind=ideal", "shadowing.sigma_db=4"]
    result, took_s, peak_mib = _command(case.positions, "wifi-b-1", settings, duration_s=30.0, compiled=False)
    peak_gib = peak_mib / 1024.0
    name = f"1000 nodes, 10 Hz, 30 s, mac ideal, shadowing: {result['frames']} frames"
    yield Row(f"{name}; beside 60 s", f"{took_s:.0f} CPU s", "60 s", took_s / 60.0, "goal: < 60 s", took_s < 60.0)
    yield Row(f"{name}; beside 1.5 GiB", f"{peak_gib:.2f} GiB", "1.5 GiB", peak_gib / 1.5, "< 1", peak_gib < 1.5)


def _ours_s(case: Case, compiled: bool) -> float:
    settings = [f"path_loss.exponent={case.exponent}"]
    result, *_ = _command(case.positions, f"wifi-{case.phy}", settings, duration_s=DURATION_S, compiled=compiled)
    return float(result["cpu_s"])


def _command(
    positions: Floats, preset: str, settings: list[str], *, duration_s: float, compiled: bool
) -> tuple[Any, float, float]:
    """Run ``vcmvsp channel``: its output, CPU seconds, and peak memory, MiB."""
    with tempfile.TemporaryDirectory() as folder:
        places = _written(positions, folder)
        words = ["channel", "--preset", preset, "--positions", str(places), "--rate", "10", "--size", "100"]
        words += ["--json", "--quiet", "--duration", str(duration_s), *(word for each in settings for word in ("--set", each))]
        command = [sys.executable, "-c", _OURS, str(int(compiled)), *words]
        printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    answer, _, used = printed.rstrip().rpartition("\n")
    cpu_s, peak_mib = map(float, used.split())
    return json.loads(answer), cpu_s, peak_mib


def _ns3_s(case: Case) -> float:
    """CPU seconds of ns-3's simulation loop."""
    with tempfile.TemporaryDirectory() as folder:
        options = {**case.ns3(1), "duration": DURATION_S, "warmup": 0.0}
        words = [f"--{name}={value}" for name, value in options.items()]
        command = [str(program()), f"--positions={_written(case.positions, folder)}", *words]
        return float(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["cpu_s"])


def _written(positions: Floats, folder: str) -> Path:
    path = Path(folder) / "positions.csv"
    path.write_text("".join(f"{x},{y},{z}\n" for x, y, z in positions.tolist()))
    return path
