"""A short run among walls, with frames lost by every cause that needs no contention."""

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from vcmvsp.cosim.runs import api

ROOMS = """
name = "rooms"
duration_s = 4.0
seed = 3
[physics]
kind = "kinematic"
[world]
kind = "boxes"
boxes = [
  { center = [10.0, 0.0, 1.25], size = [0.11, 16.0, 2.5], material = "brick" },
  { center = [20.0, 2.0, 1.25], size = [0.2, 20.0, 2.5], material = "concrete" },
]
[radio]
preset = "wifi-b-1"
mac = { kind = "ideal" }
shadowing = { sigma_db = 4.0 }
fading = { kind = "rayleigh" }
loss = { probability = 0.1 }
delay = { seconds = 0.15 }
[vehicles]
kind = "p2dx"
[agents]
kind = "trajectory"
path = "circle"
[[vehicle]]
name = "car1"
agent = {}
[[vehicle]]
name = "car2"
agent = {}
pose = [15.0, 1.0, 0.0]
[[vehicle]]
name = "car3"
agent = {}
pose = [40.0, 4.0, 0.0]
radio = { antenna_gain_dbi = 2.0, tx_power_dbm = 20.0 }
[[vehicle]]
name = "car4"
agent = {}
pose = [200.0, -20.0, 0.0]
radio = { sensitivity_dbm = -85.0 }
"""


def run_rooms(folder: Path) -> Path:
    """Run the scenario ``rooms.toml`` of a folder; returns the run's folder."""
    (folder / "rooms.toml").write_text(ROOMS)
    api.run(folder / "rooms.toml", out=folder / "run")
    return folder / "run"


def rows(folder: Path, sender: str, receiver: str) -> Any:
    """Rows of a link, read by Arrow instead of our own code."""
    table = pq.read_table(folder / "radio.parquet").to_pylist()
    return [row for row in table if (row["sender"], row["receiver"]) == (sender, receiver)]
