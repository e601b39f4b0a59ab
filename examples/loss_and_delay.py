"""What loss and delay do to a formation: a study in twenty lines, and its picture."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
RUNS = int(sys.argv[2]) if len(sys.argv) > 2 else 3  # runs of each point
QUICK = {"physics.kind": "kinematic", "duration_s": 40.0, "agents.estimator": "hold", "agents.runs": "inprocess"}


def main() -> None:
    """Three robots on a circle, at each of twelve pairs of loss and delay, with some seeds."""
    vary = {"radio.loss.probability": [0.0, 0.3, 0.6, 0.8], "radio.delay.seconds": [0.0, 0.2, 0.4]}
    table = vcmvsp.study("formation-circle", vary=vary, seeds=RUNS, set=QUICK).to_pandas()
    means = table.groupby(["radio.delay.seconds", "radio.loss.probability"])["formation.rms_m"].mean()

    figure, axes = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    for delay_s, curve in means.groupby(level=0):
        axes.plot(curve.index.get_level_values(1), 1e3 * curve.values, "o-", label=f"{delay_s:g} s")
    axes.set(xlabel="loss probability", ylabel="formation error, RMS (mm)", title="Three robots on a circle, last message held")
    axes.legend(title="delay")
    figure.savefig(FOLDER / "loss_and_delay.png", dpi=120)


if __name__ == "__main__":
    main()
