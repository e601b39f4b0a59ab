"""Checksums of short runs, compared between versions of Python: ``python -m tests.support.smoke``.

Seven scenarios, one of them again with its agents in processes, another in MuJoCo, and a study. Each line is a name and
SHA-256 sums.
"""

import hashlib
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import vcmvsp

RUNS = {
    "formation-circle": 20.0,
    "formation-slalom": 15.0,
    "lab-formation": 10.0,
    "relay-chain": 20.0,
    "recon-urban": 5.0,
    "relay-canyon": 10.0,
    "swarm-100": 1.0,
}
"""Simulated seconds by scenario."""
FILES = ("states.parquet", "radio.parquet", "metrics.json", "run.mcap")
VARY = {"radio.loss.probability": [0.0, 0.4]}


def sums() -> Iterator[str]:
    """The lines."""
    for name, duration_s in RUNS.items():
        yield f"{name} {_of_run(name, duration_s, 'inprocess')}"
    yield f"formation-circle {_of_run('formation-circle', RUNS['formation-circle'], 'process')}"
    yield f"mujoco {_of_run('lab-formation', RUNS['lab-formation'], 'inprocess', {'physics.kind': 'mujoco'})}"
    table = vcmvsp.study("formation-circle", vary=VARY, seeds=2, set={"duration_s": 5.0}, jobs=2)
    yield f"study {' '.join(map(str, table['digest'].to_pylist()))}"


def _of_run(name: str, duration_s: float, agents: Literal["inprocess", "process"], keys: Mapping[str, Any] = {}) -> str:
    with tempfile.TemporaryDirectory() as folder:
        vcmvsp.run(name, set={"duration_s": duration_s, "agents.deadline_s": 500.0, **keys}, agents=agents, out=folder)
        return " ".join(hashlib.sha256((Path(folder) / file).read_bytes()).hexdigest() for file in FILES)


if __name__ == "__main__":
    for line in sums():
        sys.stdout.write(f"{line}\n")
