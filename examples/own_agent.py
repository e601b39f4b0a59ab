"""An agent of one's own: five robots agree on a place to meet, over a radio that loses messages."""

import math
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

import vcmvsp
from vcmvsp import Agent, Observation, Radio, Velocity
from vcmvsp.cosim.testing import check_agent

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
STARTS = {"a": (-4.0, -1.0), "b": (-1.0, 4.0), "c": (3.0, 3.0), "d": (5.0, -2.0), "e": (0.0, -4.0)}  # m
LOSSES = (0.0, 0.9)


class Rendezvous(Agent):
    """Drive to the mean of the positions that were heard; stop a little before the others."""

    def __init__(self, gain: float = 0.3, apart_m: float = 1.0) -> None:
        self.gain, self.apart_m = gain, apart_m
        self.known: dict[str, tuple[float, float]] = {}

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        for sender, reception in obs.heard.latest_by_sender().items():
            body = reception.message.body
            place = (body.get("x"), body.get("y")) if isinstance(body, dict) else (None, None)
            if all(isinstance(value, float) and math.isfinite(value) for value in place):
                self.known[sender] = place
        x, y, _ = obs.state.position
        radio.send(x=x, y=y)
        if not self.known:
            return Velocity()
        away_x = sum(other[0] - x for other in self.known.values()) / len(self.known)
        away_y = sum(other[1] - y for other in self.known.values()) / len(self.known)
        far_m = math.hypot(away_x, away_y)
        self.note(disagreement_m=far_m)
        turn = vcmvsp.wrap(math.atan2(away_y, away_x) - obs.state.yaw)
        speed = self.gain * max(0.0, far_m - self.apart_m) * max(0.0, math.cos(turn))
        return Velocity(linear=(min(0.6, speed), 0.0, 0.0), yaw_rate=1.5 * turn if far_m > self.apart_m else 0.0)


def meeting(loss: float) -> tuple[vcmvsp.Result, list[tuple[float, float]]]:
    """A run, and (time, disagreement) of all robots' notes."""
    cars = [{"name": name, "position": [*place, 0.0]} for name, place in STARTS.items()]
    scenario: dict[str, Any] = {"name": "meeting", "duration_s": 40.0, "vehicles": {"kind": "p2dx"}, "vehicle": cars}
    scenario["radio"] = {"preset": "wifi-b-1", "loss": {"probability": loss}}
    noted: list[tuple[float, float]] = []

    def observe(event: Any) -> None:
        if event.key.endswith("/note"):
            noted.append((event.time_ns / 1e9, event.value.values["disagreement_m"]))

    agents = {name: Rendezvous() for name in STARTS}
    return vcmvsp.run(scenario, seed=1, agents=agents, mcap=False, observe=observe), noted


def main() -> None:
    """Run with and without loss, and draw paths and notes."""
    check_agent(Rendezvous)
    figure, (paths, notes) = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
    for loss, style in zip(LOSSES, ("-", "--"), strict=True):
        result, noted = meeting(loss)
        for number, (name, path) in enumerate(result.states.to_pandas().groupby("vehicle", observed=True)):
            paths.plot(path.x, path.y, style, color=f"C{number}", label=f"robot {name}" if loss == LOSSES[0] else None)
        worst = dict(sorted(noted))  # the largest of an instant comes last
        notes.plot([*worst], [*worst.values()], style, color="black", label=f"loss {loss:.0%}")
    paths.plot(*zip(*STARTS.values(), strict=True), "ko", markersize=4, label="start")
    paths.set(xlabel="x (m)", ylabel="y (m)", title=f"Paths: no loss solid, loss {LOSSES[1]:.0%} dashed", aspect="equal")
    paths.legend(fontsize="small")
    notes.set(
        xlabel="time (s)",
        ylabel="distance to the mean of the others, largest (m)",
        title="What the agents noted",
        ylim=(0, None),
    )
    notes.legend()
    figure.savefig(FOLDER / "own_agent.png", dpi=120)


if __name__ == "__main__":
    main()
