"""A layer of the radio of one's own: reflection from the ground, beside a law of distance."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import vcmvsp
from vcmvsp import Agent, Observation, Radio, Velocity
from vcmvsp.cosim.testing import check_channel

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")


@dataclass(frozen=True)
class TwoRays:
    """Loss over flat ground that reflects, with the fades of both rays; the built-in `two_ray_ground` has none."""

    height_m: float = 1.0  # of both antennas
    frequency_hz: float = 2.4e9
    reflection: float = -0.9  # of the ground, at grazing incidence

    def loss_db(self, paths: Any) -> Any:
        wave = 299_792_458.0 / self.frequency_hz
        distance_m = np.maximum(paths.distance_m, 0.1)
        longer_m = np.sqrt(distance_m**2 + (2.0 * self.height_m) ** 2)
        rays = np.exp(-2j * np.pi * distance_m / wave) / distance_m
        rays = rays + self.reflection * np.exp(-2j * np.pi * longer_m / wave) / longer_m
        return -20.0 * np.log10(wave / (4.0 * np.pi) * np.abs(rays))


class Away(Agent):
    """Drive away from the other, and send."""

    period = 0.02  # s

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        radio.send(size_bytes=100)
        return Velocity(linear=(10.0, 0.0, 0.0))


def levels(path_loss: dict[str, Any]) -> Any:
    """Frames of the one that drives away, with distance and level."""
    scenario: dict[str, Any] = {
        "name": "away",
        "duration_s": 60.0,
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "wifi-b-1", "path_loss": path_loss},
        "vehicles": {"kind": "kinematic"},
        "vehicle": [{"name": "still"}, {"name": "away", "position": [2.0, 0.0, 0.0]}],
    }
    return vcmvsp.run(scenario, agents={"away": Away()}, mcap=False).radio.to_pandas()


def main() -> None:
    """Draw the level against distance, and where frames are lost."""
    check_channel(TwoRays())
    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    laws = {
        "log-distance, exponent 3": {"kind": "log_distance", "exponent": 3.0},
        "own layer: two rays": {"kind": f"{Path(__file__).resolve()}:TwoRays"},
    }
    for number, (name, law) in enumerate(laws.items()):
        frames = levels(law)
        lost = frames[frames.outcome != "received"]
        axes.semilogx(frames.distance_m, frames.rssi_dbm, color=f"C{number}", label=name)
        axes.plot(
            lost.distance_m, lost.rssi_dbm, "x", color=f"C{number}", markersize=4, label=f"lost: {len(lost)} of {len(frames)}"
        )
    axes.set(xlabel="distance (m)", ylabel="received power (dBm)", title="802.11b, 1 Mbit/s, antennas 1 m above the ground")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(FOLDER / "own_radio_layer.png", dpi=120)


if __name__ == "__main__":
    main()
