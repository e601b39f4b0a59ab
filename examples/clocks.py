"""What clocks that differ do to a formation, and what synchronisation over the same radio brings back."""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
DURATION_S = float(sys.argv[2]) if len(sys.argv) > 2 else 300.0
SPEED, SLOT = 0.5, [-1.0, 0.0]
CLOCKS: dict[str, dict[str, float]] = {
    "one clock": {},
    "50 ms ahead": {"offset_s": 0.05},
    "50 ms ahead, 200 ppm fast": {"offset_s": 0.05, "drift_ppm": 200.0},
}
LEAD: dict[str, Any] = {"kind": "trajectory", "path": "straight", "speed": SPEED}
FOLLOW: dict[str, Any] = {"kind": "leader_follower", "leader": "car1", "slot": SLOT, "clock_bound_s": 1.0}


def scenario(clock: dict[str, float], *, synchronised: bool) -> dict[str, Any]:
    """A follower with this clock behind a leader; a tenth of the frames is lost, none takes the same time."""
    agents: list[dict[str, Any]] = [LEAD, FOLLOW]
    if synchronised:
        agents = [{"kind": "time_sync", "task": LEAD}, {"kind": "time_sync", "reference": "car1", "task": FOLLOW}]
    return {
        "name": "clocks",
        "duration_s": DURATION_S,
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "wifi-g-6", "loss": {"probability": 0.1}, "delay": {"seconds": 0.01, "jitter_s": 0.005}},
        "vehicle": [
            {"name": "car1", "kind": "p2dx", "agent": agents[0]},
            {"name": "car2", "kind": "p2dx", "position": [*SLOT, 0.0], "agent": agents[1], "clock": clock or {"offset_s": 0.0}},
        ],
    }


def main() -> None:
    """The formation error over time, with what ``speed (offset + drift t)`` gives."""
    figure, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
    for color, (name, clock) in zip(("tab:green", "tab:blue", "tab:red"), CLOCKS.items(), strict=True):
        for synchronised, look in ((False, "-"), (True, ":"))[: 2 if clock else 1]:
            errors = vcmvsp.run(scenario(clock, synchronised=synchronised), mcap=False).errors.to_pandas()
            words = f"{name}, time_sync" if synchronised else name
            axes.plot(errors["time_ns"] * 1e-9, errors["error_m"], look, color=color, label=words, linewidth=1.2)
        time_s = np.array([0.0, DURATION_S])
        ahead_s = clock.get("offset_s", 0.0) + 1e-6 * clock.get("drift_ppm", 0.0) * time_s
        axes.plot(time_s, SPEED * ahead_s, "k--", linewidth=0.8, label="" if clock else "speed (offset + drift t)")
    axes.set(xlabel="time [s]", ylabel="formation error [m]", xlim=(0.0, DURATION_S), ylim=(0.0, None))
    axes.legend(fontsize="small", loc="upper left")
    figure.savefig(FOLDER / "clocks.png", dpi=100)


if __name__ == "__main__":
    main()
