"""A scenario whose runs take a hundredth of a second, and arguments of its studies."""

import subprocess
from pathlib import Path
from typing import Any

import pyarrow as pa

from tests.support.cosim.run_processes import VCMVSP

LOSS = "radio.loss.probability"
ESTIMATOR = "agents.estimator"


def two(**more: Any) -> dict[str, Any]:
    """A leader and a follower, points without bodies, over a lossy channel."""
    return {
        "name": "two",
        "duration_s": 1.0,
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "ideal", "loss": {"kind": "bernoulli", "probability": 0.0}},
        "vehicles": {"kind": "kinematic"},
        "agents": {"period_s": 0.1, "estimator": "hold"},
        "vehicle": [
            {"name": "car1", "agent": {"kind": "trajectory", "path": "slalom"}},
            {"name": "car2", "pose": [-0.9, -0.5, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
        ],
        **more,
    }


AGENT = """
import os
import time
from vcmvsp import Agent, Velocity


class Mine(Agent):
    def __init__(self, bad_seed: int = -1, nap_s: float = 0.0, mark: str = "", held_by: str = "", held_from: int = 0) -> None:
        self.bad_seed, self.nap_s, self.mark, self.held_by, self.held_from = bad_seed, nap_s, mark, held_by, held_from

    def start(self, info):
        self.seed = info.seed

    def act(self, obs, radio):
        if obs.time_ns == 0:
            if self.mark:
                open(self.mark, "a").write(".")
            time.sleep(self.nap_s)
            while self.seed >= self.held_from and os.path.exists(self.held_by):
                time.sleep(0.01)
        if self.seed == self.bad_seed and obs.time_ns:
            raise RuntimeError("not with\\nthis seed")
        return Velocity(linear=(0.1, 0.0, 0.0))
"""

MINE = """
name = "mine"
duration_s = 0.5
[physics]
kind = "kinematic"
[radio]
preset = "ideal"
[agents]
nap_s = 0.0
[[vehicle]]
name = "car1"
kind = "kinematic"
agent = { kind = "mine.py:Mine" }
"""


def mine(folder: Path) -> Path:
    """A scenario file with a user agent beside it, which can fail, or wait as long as a file exists."""
    (folder / "mine.py").write_text(AGENT)
    (folder / "mine.toml").write_text(MINE)
    return folder / "mine.toml"


def start(folder: Path, *arguments: str) -> "subprocess.Popen[str]":
    """Start ``vcmvsp study`` in a process of its own."""
    command = [*VCMVSP, "study", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def columns(table: pa.Table, *names: str) -> list[tuple[Any, ...]]:
    """Columns of a table, row by row."""
    return list(zip(*(table[name].to_pylist() for name in names), strict=True))
