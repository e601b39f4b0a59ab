"""A base hears a robot round two corners by its relays: with log-distance and walls, and with rays."""

import sys
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
MODELS = {
    "log-distance and walls": {"radio.path_loss": {"kind": "log_distance"}, "radio.walls.kind": "itu"},
    "rays": {"radio.path_loss.reflections": 2},
}
BOXES = tomllib.loads((Path(vcmvsp.__file__).parent / "scenarios" / "relay-canyon.toml").read_text("utf-8"))["world"]["boxes"]
COLORS = {"log-distance and walls": "tab:orange", "rays": "tab:blue"}
RELAYS, SHOWN = [1, 2, 3, 4], 3  # numbers of relays, and that of the maps
SPEED, WINDOW = 2.0, 9  # m/s of the leader; messages that a point of the curve is the mean of


def heard_at_base(result: vcmvsp.Result) -> tuple[np.ndarray, np.ndarray]:
    """Time of each message of the leader, s, and whether it came to the base."""
    frames = result.radio.to_pandas()
    own = frames[frames["origin"] == "leader"]
    sent = own.groupby("origin_number")["origin_sent_ns"].first()
    arrived = own[(own["receiver"] == "base") & (own["outcome"] == "received")]["origin_number"].unique()
    return sent.to_numpy() * 1e-9, np.isin(sent.index, arrived)


def draw_map(axes: plt.Axes, result: vcmvsp.Result, time_s: np.ndarray, heard: np.ndarray) -> None:
    """Buildings, and where the leader was at each message."""
    for box in BOXES:
        (x, y, _), (length, width, _) = box["center"], box["size"]
        axes.add_patch(plt.Rectangle((x - length / 2, y - width / 2), length, width, facecolor="0.85", edgecolor="0.6"))
    track = result.states.to_pandas().query("vehicle == 'leader'")
    x, y = (np.interp(time_s, track["time_ns"] * 1e-9, track[axis]) for axis in ("x", "y"))
    for words, rows, look in (("heard at the base", heard, "go"), ("not heard", ~heard, "rx")):
        axes.plot(x[rows], y[rows], look, markersize=4, label=words)
    axes.plot(-5.0, 4.0, "k^", label="base")
    axes.set(xlim=(-60, 150), ylim=(-25, 105), xlabel="x east [m]", ylabel="y north [m]", aspect="equal")


def main() -> None:
    """Where the base hears the leader, the share of its messages along the way, and over the number of relays."""
    figure = plt.figure(figsize=(10.0, 7.0), layout="constrained")
    panels = figure.subplot_mosaic([list(MODELS), ["way", "relays"]], height_ratios=[1.3, 1.0])
    for name, keys in MODELS.items():
        ratios = []
        for relays in RELAYS:
            result = vcmvsp.run("relay-canyon", set={**keys, "vehicle.relay.count": relays}, mcap=False)
            time_s, heard = heard_at_base(result)
            ratios.append(100.0 * heard.mean())
            if relays == SHOWN:
                draw_map(panels[name], result, time_s, heard)
                share = 100.0 * np.convolve(heard, np.ones(WINDOW) / WINDOW, "valid")
                panels["way"].plot(SPEED * time_s[WINDOW // 2 : -(WINDOW // 2)], share, color=COLORS[name], label=name)
        panels[name].set_title(f"{name}, {SHOWN} relays")
        panels["relays"].plot(RELAYS, ratios, "o-", color=COLORS[name], label=name)
    panels["rays"].legend(loc=(0.03, 0.56))
    panels["way"].set(
        xlabel="way of the leader [m]", ylabel="heard at the base [%]", ylim=(-5.0, 105.0), title=f"{SHOWN} relays"
    )
    panels["relays"].set(xlabel="relays", ylabel="heard at the base [%]", xticks=RELAYS, ylim=(0.0, 105.0), title="all the way")
    panels["relays"].legend(loc="lower right")
    figure.savefig(FOLDER / "relay_canyon.png", dpi=100)


if __name__ == "__main__":
    main()
