"""A vehicle of one's own: a cart from a URDF file, beside a Pioneer 2-DX that gets the same commands."""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

import vcmvsp
from vcmvsp import Agent, Observation, Radio, Velocity

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
HERE = Path(__file__).resolve().parent


class Corner(Agent):
    """Straight on, a turn to the left, straight on, stop."""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        if obs.time_s < 4.0:
            return Velocity(linear=(0.8, 0.0, 0.0))
        if obs.time_s < 6.0:
            return Velocity(linear=(0.8, 0.0, 0.0), yaw_rate=0.785)
        return Velocity(linear=(0.8 if obs.time_s < 9.0 else 0.0, 0.0, 0.0))


SCENARIO: dict[str, Any] = {
    "name": "corner",
    "duration_s": 12.0,
    "record": {"period_s": 0.05},
    "physics": {"kind": "bullet", "rate_hz": 240.0},
    "vehicle": [
        {
            "name": "cart",
            "kind": "urdf",
            "file": str(HERE / "cart.urdf"),
            "left_wheel": "left_wheel",
            "right_wheel": "right_wheel",
            "max_speed": 1.2,
            "accel": 0.8,
        },
        {"name": "pioneer", "kind": "p2dx", "position": [0.0, -1.5, 0.0]},
    ],
}


def main() -> None:
    """Drive both, and draw paths and speeds."""
    states = vcmvsp.run(SCENARIO, agents={"cart": Corner(), "pioneer": Corner()}, mcap=False).states.to_pandas()
    figure, (paths, speeds) = plt.subplots(1, 2, figsize=(10.0, 4.0), layout="constrained")
    for name, path in states.groupby("vehicle", observed=True):
        paths.plot(path.x, path.y, label=name)
        speeds.plot(path.time_ns / 1e9, (path.vx**2 + path.vy**2) ** 0.5, label=name)
    paths.set(xlabel="x (m)", ylabel="y (m)", title="The same commands", aspect="equal")
    paths.legend()
    speeds.axhline(0.8, color="0.7", linestyle=":", label="commanded until 9 s")
    speeds.set(xlabel="time (s)", ylabel="speed (m/s)", title="Acceleration and braking")
    speeds.legend()
    figure.savefig(FOLDER / "own_vehicle.png", dpi=120)


if __name__ == "__main__":
    main()
