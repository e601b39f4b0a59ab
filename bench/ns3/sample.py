"""Compared results of one run, from either simulator."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bench.ns3 import program
from bench.ns3.cases import Case
from bench.ns3.program import Floats, Frames, Ints
from vcmvsp.cosim.clock import SECOND_NS

BIN_M = 10.0  # of distance
BINS = 128


class Sample(NamedTuple):
    """One run: frames that were offered in the measured time."""

    delay_ns: Ints  # (r,) of every reception
    intended: Ints  # (BINS,) frames times intended receivers, by distance
    received: Ints  # (BINS,)
    cpu_s: float


def ns3(case: Case, seed: int) -> Sample:
    """Run of ns-3."""
    result = program.run(case.positions, case.ns3(seed))
    return tally(case.positions, result.frames, result.totals["cpu_s"])


def tally(positions: Floats, frames: Frames, cpu_s: float) -> Sample:
    """Results of the frames of n nodes at ``positions`` (n, 3) m."""
    n = len(positions)
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    place = np.minimum(distance // BIN_M, BINS - 1).astype(np.int64)
    intended: NDArray[np.bool_] = (frames.to[:, None] == np.arange(n)) | (
        (frames.to[:, None] < 0) & (frames.sender[:, None] != np.arange(n))
    )
    where = place[frames.sender]
    arrived = intended & (frames.delay_ns >= 0)
    delay_ns = frames.delay_ns[arrived].astype(np.int64)
    return Sample(delay_ns, np.bincount(where[intended], minlength=BINS), np.bincount(where[arrived], minlength=BINS), cpu_s)


def command(case: Case, seed: int) -> Sample:
    """``vcmvsp channel`` on the same positions."""
    if case.unicast or case.sink or case.saturated or case.ideal or case.rts_bytes is not None:
        raise NotImplementedError("the command neither addresses frames nor keeps queues full")
    keys: dict[str, str | float] = {"path_loss.exponent": case.exponent}
    if case.errors != "table":
        keys["phy.error_model"] = case.errors
    if case.nakagami:
        keys |= {"fading.kind": "nakagami", "fading.m": case.nakagami}
    with tempfile.TemporaryDirectory() as folder:
        places, out = Path(folder) / "positions.csv", Path(folder) / "frames.parquet"
        places.write_text("x,y,z\n" + "".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in case.positions.tolist()))
        words = ["--preset", f"wifi-{case.phy}", "--positions", str(places), "--rate", f"{case.hz}", "--size", f"{case.size}"]
        words += ["--duration", f"{case.warmup_s + case.duration_s + case.drain_s}", "--seed", f"{seed}", "--out", str(out)]
        words += [word for key, value in keys.items() for word in ("--set", f"{key}={json.dumps(value)}")]
        program_ = Path(sys.executable).with_name("vcmvsp")
        result = subprocess.run(
            [str(program_), "channel", *words, "--json", "--quiet"], check=True, text=True, stdout=subprocess.PIPE
        )
        table = pq.read_table(out, columns=["sent_ns", "distance_m", "delay_ns", "received_ns"])
        totals = json.loads(result.stdout)
    sent_ns = table["sent_ns"].to_numpy()
    counts = (sent_ns >= case.warmup_s * SECOND_NS) & (sent_ns < (case.warmup_s + case.duration_s) * SECOND_NS)
    arrived = counts & ~table["received_ns"].is_null().to_numpy()
    place = np.minimum(table["distance_m"].to_numpy() // BIN_M, BINS - 1).astype(np.int64)
    delay_ns = table["delay_ns"].to_numpy(zero_copy_only=False)[arrived]  # floating where some are null; exact up to 2^53
    return Sample(
        delay_ns.astype(np.int64),
        np.bincount(place[counts], minlength=BINS),
        np.bincount(place[arrived], minlength=BINS),
        float(totals.get("cpu_s", float("nan"))),
    )
