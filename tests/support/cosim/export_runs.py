"""Short runs of built-in scenarios with everything recorded, made once per process."""

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from vcmvsp.cosim.recording import mcap_writer
from vcmvsp.cosim.recording.mcap_reader import messages

_FOLDER = tempfile.TemporaryDirectory(prefix="vcmvsp-exports-")
ALL = {"record.sensors": ["*"]}
FOLLOWS = {"kind": "leader_follower", "leader": "car-1", "distance": 1.0, "bearing_deg": 30.0}
RUNS: Mapping[str, tuple[str | dict[str, Any], dict[str, Any]]] = {
    "lab-patrol": ("lab-patrol", {"duration_s": 2.0, **ALL}),
    "pillar-triangle": ("pillar-triangle", {"duration_s": 2.0, **ALL}),
    "recon-team": ("recon-team", {"duration_s": 0.6, **ALL}),
    "a crossing cart": (
        {
            "name": "cart",
            "duration_s": 2.0,
            "physics": {"kind": "kinematic"},
            "world": {
                "kind": "boxes",
                "boxes": [{"center": [0.0, 3.0, 0.5], "size": [2.0, 0.2, 1.0]}],
                "moving": [
                    {
                        "name": "cart",
                        "solid": {"kind": "box", "center": [0, 0, 0.3], "size": [0.6, 0.4, 0.6]},
                        "times_s": [0.0, 10.0],
                        "way": [[3.0, -1.0, 0.3, 0.0], [3.0, 9.0, 0.3, 0.0]],
                    }
                ],
            },
            "radio": {"loss": {"kind": "bernoulli", "probability": 0.5}},
            "vehicle": [
                {"name": "car-1", "kind": "p2dx", "agent": {"kind": "trajectory", "path": "straight", "speed": 0.3}},
                {"name": "car-2", "kind": "p2dx", "pose": [-1.0, -0.5, 0.0], "agent": FOLLOWS},
            ],
        },
        ALL,
    ),
    "a tag and late sensors": (
        {
            "name": "late",
            "duration_s": 1.0,
            "physics": {"kind": "kinematic"},
            "world": {"kind": "boxes", "boxes": [{"center": [0.0, 3.0, 0.5], "size": [2.0, 0.2, 1.0]}]},
            "vehicle": [
                {
                    "name": "car",
                    "kind": "p2dx",
                    "pose_source": "positioning",
                    "positioning": {"rate_hz": 5.0, "heading": False},
                    "sensors": {
                        "path": {"kind": "imu", "latency_s": 0.05},
                        "scan": {"kind": "lms", "latency_s": 0.05},
                        "camera": {"kind": "camera", "latency_s": 0.05},
                    },
                    "agent": {"kind": "trajectory"},
                }
            ],
        },
        ALL,
    ),
}


@functools.cache
def run_of(name: str) -> Path:
    """Folder of a recorded run; read-only for tests."""
    scenario, settings = RUNS[name]
    folder = Path(_FOLDER.name) / name.replace(" ", "-")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_writer, "CHUNK_BYTES", 1 << 18)  # so that even a short one has several
        vcmvsp.run(scenario, set=settings, agents="inprocess", out=folder)
    return folder


def topic_messages(name: str, topic: str) -> list[tuple[int, Any]]:
    """Time (ns) and content of each message of a topic of a run's recording."""
    with (run_of(name) / "run.mcap").open("rb") as stream:
        return [(time_ns, json.loads(data)) for each, time_ns, data in messages(stream) if each == topic]


def rerun(*arguments: str) -> str:
    """Output of Rerun's command line, with its analytics off."""
    environment = {**os.environ, "DO_NOT_TRACK": "1", "RERUN_ANALYTICS": "0"}
    command = [str(Path(sys.executable).with_name("rerun")), *arguments]
    process = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert process.returncode == 0, process.stderr
    return process.stdout


def truncated_copy(name: str, folder: Path, part: float) -> Path:
    """A copy of a killed run: the beginning of its recording, and no other file."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = (run_of(name) / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(whole[: round(part * len(whole))])
    return folder
