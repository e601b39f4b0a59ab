"""A consensus formation: each robot drives to its place around the centre on which all agree by radio; and its metric."""

import math

import numpy as np

from vcmvsp import Agent, Observation, Radio, Result, Velocity

HANDLE_M = 0.2  # the point that is steered lies so far ahead of the axle


class Agreement(Agent):
    """Drive to the mean of the centres that the others send, each its own position minus its place in the shape."""

    def __init__(self, place: tuple[float, float], gain: float = 0.5) -> None:
        self.place, self.gain = place, gain
        self.centres: dict[str, tuple[float, float]] = {}

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        for sender, reception in obs.heard.latest_by_sender().items():
            body = reception.message.body
            centre = (body.get("x"), body.get("y")) if isinstance(body, dict) else (None, None)
            if all(isinstance(value, float) and math.isfinite(value) for value in centre):
                self.centres[sender] = centre
        yaw = obs.state.yaw
        own_x = obs.state.position[0] + HANDLE_M * math.cos(yaw) - self.place[0]
        own_y = obs.state.position[1] + HANDLE_M * math.sin(yaw) - self.place[1]
        radio.send(x=own_x, y=own_y)
        away_x = sum(x - own_x for x, _ in self.centres.values()) / max(1, len(self.centres))
        away_y = sum(y - own_y for _, y in self.centres.values()) / max(1, len(self.centres))
        self.note(disagreement_m=math.hypot(away_x, away_y))
        forward = self.gain * (away_x * math.cos(yaw) + away_y * math.sin(yaw))
        turning = self.gain * (away_y * math.cos(yaw) - away_x * math.sin(yaw)) / HANDLE_M
        return Velocity(linear=(max(-0.5, min(0.5, forward)), 0.0, 0.0), yaw_rate=max(-1.0, min(1.0, turning)))


def agreed_s(run: Result, within_m: float = 0.05) -> float | None:
    """Time from which no robot notes a disagreement above a bound (s); None: never."""
    noted = run.notes.to_pandas().query("name == 'disagreement_m'").groupby("time_ns")["value"].max()
    above = np.flatnonzero(noted > within_m)
    last = above[-1] + 1 if above.size else 0
    return noted.index[last] / 1e9 if last < len(noted) else None
