"""A study with bands: which estimator stands how much loss, with 95 % bands over ten runs of each point."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
RUNS = int(sys.argv[2]) if len(sys.argv) > 2 else 10  # runs of each point
QUICK = {"physics.kind": "kinematic", "duration_s": 40.0, "agents.runs": "inprocess"}
VARY = {"agents.estimator": ["hold", "dr", "plan"], "radio.loss.probability": [0.0, 0.3, 0.6, 0.9]}


def band(values: "np.ndarray") -> tuple[float, float]:
    """95 % band of the mean, by drawing runs again and again (bootstrap)."""
    drawn = np.random.default_rng(1).choice(values, (1000, len(values)))
    low, high = np.quantile(drawn.mean(axis=1), [0.025, 0.975])
    return low, high


def main() -> None:
    """Run a grid on all cores, and draw means and bands."""
    table = vcmvsp.study("formation-slalom", vary=VARY, seeds=RUNS, set=QUICK).to_pandas()
    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for estimator, rows in table.groupby("agents.estimator", sort=False):
        points = rows.groupby("radio.loss.probability")["formation.rms_m"]
        losses = list(points.groups)
        bands = np.array([band(points.get_group(each).to_numpy()) for each in losses])
        axes.plot(losses, points.mean(), "o-", label=estimator)
        axes.fill_between(losses, bands[:, 0], bands[:, 1], alpha=0.25)
    axes.set(
        xlabel="loss probability",
        ylabel="formation error, RMS (m)",
        yscale="log",
        title=f"Leader on a slalom: means and 95 % bands of {RUNS} runs",
    )
    axes.grid(alpha=0.3)
    axes.legend(title="estimator")
    figure.savefig(FOLDER / "study_bands.png", dpi=120)


if __name__ == "__main__":
    main()
