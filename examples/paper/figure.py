"""The figure of a paper: how long three robots take to agree on a formation, over the loss of messages, with bands."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

import vcmvsp

HERE = Path(__file__).parent
FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
RUNS = int(sys.argv[2]) if len(sys.argv) > 2 else None  # runs of each point; None: as the study says
QUANTITIES = {"own.agreed_s": "time to agreement (s)", "own.disagreement_m": "disagreement, RMS (m)"}


def main() -> None:
    """Run the study on all cores, or finish it, and draw means and 95 % bands."""
    study = FOLDER / "agreement"
    vcmvsp.study(HERE / "agreement.toml", out=study, seeds=RUNS, resume=study.exists())
    summary = pd.read_csv(study / "summary.csv")
    figure, panels = plt.subplots(1, 2, figsize=(7.0, 2.8), layout="constrained")
    for axes, (name, label) in zip(panels, QUANTITIES.items(), strict=True):
        loss = summary["radio.loss.probability"]
        axes.plot(loss, summary[f"{name}.mean"], "o-", markersize=3)
        axes.fill_between(loss, summary[f"{name}.low"], summary[f"{name}.high"], alpha=0.25)
        axes.set(xlabel="loss probability", ylabel=label)
        axes.grid(alpha=0.3)
    figure.savefig(FOLDER / "figure.pdf")
    figure.savefig(FOLDER / "figure.png", dpi=150)


if __name__ == "__main__":
    main()
