"""Scenarios of the formation figures, and functions that read their runs.

Standard triangle: car2 keeps 1 m to its leader at +30 degrees (right-behind), car3 at -30 degrees, so that L = 0.866 m,
L' = +-0.5 m; gains k1 = 0.8, k2 = 0.5 1/s; the leader drives at 0.3 m/s. The thesis gives only the triangle.

The error z of a follower is computed here from true poses and the slot in the *scenario*, independent of the agent:
``z = Rot(-th_f) (p_l + Rot(th_l) (slot + (ell, 0)) - p_f - ell (cos th_f, sin th_f))`` (Toh 2012, 3-31, 3-34).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.metrics.formation import formation_errors
from vcmvsp.cosim.metrics.motion import Motion, motion
from vcmvsp.cosim.reproduction.runner import Job
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array

T, V, W, R = 0.1, 0.3, 0.15, 2.0  # s; the leader's m/s, rad/s and m
K1, K2 = 0.8, 0.5  # 1/s
AHEAD, ASIDE = math.cos(math.radians(30.0)), 0.5  # L, L' of car2, m
RIGHT_BEHIND, LEFT_BEHIND = {"bearing_deg": 30.0}, {"bearing_deg": -30.0}
TRIANGLE = (RIGHT_BEHIND, LEFT_BEHIND)
UNLIMITED = {"max_reverse": 1e9, "timeout_s": 1e9, "horizon_s": 1e9}  # closed forms have no such limits
IDEAL: Mapping[str, Any] = {"preset": "ideal"}
STEP = "vcmvsp.cosim.reproduction.figures.formation.steps:StepFollower"


@dataclass(frozen=True)
class Tracks:
    """True poses at the m recorded instants, and the error of every follower."""

    time_s: Array  # (m,)
    pose: Array  # (m, vehicles, 3): x m, y m, yaw rad
    z: Array  # (m, followers, 2) m: forward and left in the follower's frame

    @property
    def error(self) -> Array:
        """``|z|`` (m, followers) in m."""
        return np.hypot(self.z[..., 0], self.z[..., 1])


class TeamRun(NamedTuple):
    """Data of a run of a team that may change its shape: m instants, n vehicles, the leader first."""

    time_s: Array  # (m,)
    place: Array  # (m, n, 2) m, from above
    error: Array  # (m, n - 1) m, |z| of the followers
    is_column: Array  # (m,) bool: the slot of the first follower is right behind
    metrics: Mapping[str, Any]


def team_run(result: Result, names: Sequence[str]) -> TeamRun:
    """Read tracks, errors and shape of these vehicles, car1 first."""
    movement = motion(result.states)
    errors = formation_errors(movement, result.follows)
    is_column = np.zeros(len(movement.time_ns), bool)
    for each in result.follows:
        if each.vehicle == names[1]:
            is_column[movement.time_ns >= each.time_ns] = each.follows.slot[1] == 0.0
    followers = np.stack([errors[name] for name in names[1:]], axis=-1)
    return TeamRun(movement.time_ns / 1e9, places_of(movement, names), followers, is_column, result.metrics)


def places_of(movement: Motion, names: Sequence[str]) -> Array:
    """Positions of these vehicles in the plane, (m, n, 2) m."""
    columns = [movement.column(name) for name in names]
    return np.stack([movement.position[axis][:, columns] for axis in (0, 1)], axis=-1)


def scene(name: str, duration_s: float, cars: Sequence[Mapping[str, Any]], /, **tables: object) -> dict[str, Any]:
    """A scenario of these vehicles: without inertia and with an ideal radio, unless further tables change that."""
    fixed = {"physics": {"kind": "kinematic"}, "radio": IDEAL}
    return {"name": name, "duration_s": duration_s, "vehicle": cars, **fixed, **tables}


def fleet(
    duration_s: float,
    followers: Sequence[Mapping[str, Any]] = TRIANGLE,
    *,
    path: str = "circle",
    leader: Mapping[str, Any] | None = None,
    kind: str = "kinematic",
    vehicles: Mapping[str, Any] | None = None,
    **tables: object,
) -> dict[str, Any]:
    """A scenario in which car1 leads from the origin and car2, car3, ... follow it.

    Args:
        duration_s: duration of the run.
        followers: the agent's parameters of each; ``leader``, if not car1, and ``pose``, the start, by default in its slot,
        may be among them.
        path: path of the leader.
        leader: further parameters of the leader's agent.
        kind: kind of all vehicles.
        vehicles: further defaults for all vehicles.
        tables: other tables of the scenario, such as ``radio``; default: an ideal radio.
    """
    cars: list[dict[str, Any]] = [{"name": "car1", "agent": {"kind": "trajectory", "path": path, **(leader or {})}}]
    starts = {"car1": (0.0, 0.0, 0.0)}
    for number, follower in enumerate(followers, 2):
        name = f"car{number}"
        agent = {
            "kind": "leader_follower",
            "leader": "car1",
            **{key: value for key, value in follower.items() if key != "pose"},
        }
        x, y, _ = starts[agent["leader"]]
        slot_x, slot_y, _ = place_of(agent)
        starts[name] = follower.get("pose", (x + slot_x, y + slot_y, 0.0))
        cars.append({"name": name, "pose": starts[name], "agent": agent})
    return scene("figure", duration_s, cars, vehicles={"kind": kind, **(vehicles or {})}, **tables)


def lossy(probability: float = 0.0, delay_s: float = 0.0) -> dict[str, Any]:
    """A radio without range or bandwidth limits, with independent losses and a constant delay."""
    return {
        "preset": "ideal",
        "loss": {"kind": "bernoulli", "probability": probability},
        "delay": {"kind": "fixed", "seconds": delay_s},
    }


def place_of(agent: Mapping[str, Any]) -> tuple[float, float, float]:
    """Slot of a follower in its leader's frame, x and y in m, and the length of its handle, m.

    For a follower with a step, the slot after the step.
    """
    table = {**agent, **agent.get("after", {})}
    bearing, distance = math.radians(table.get("bearing_deg", 0.0)), table.get("distance", 1.0)
    ahead, aside = distance * math.cos(bearing), distance * math.sin(bearing)
    return -ahead, -aside, table.get("handle", ahead)


def step_follower(at_s: float, behind: float = 0.0, left: float = 0.0, **law: object) -> dict[str, Any]:
    """A follower in steady motion behind and to the left of the slot of car2, commanded into it at ``at_s``.

    So the step begins with all vehicles at equal speed and with the newest report in use.
    """
    x, y = -AHEAD - behind, -ASIDE + left
    before = {"distance": math.hypot(x, y), "bearing_deg": math.degrees(math.atan2(-y, -x))}
    return {
        "kind": STEP,
        "at_s": at_s,
        "before": before,
        "after": {**RIGHT_BEHIND, "distance": 1.0, **UNLIMITED, **law},
        "pose": (x, y, 0.0),
    }


def tracks(result: Result, scenario: Mapping[str, Any]) -> Tracks:
    """Read poses and errors of a run of `fleet`."""
    movement = motion(result.states)
    x, y, _ = movement.position
    z = []
    for car in scenario["vehicle"][1:]:
        slot_x, slot_y, handle = place_of(car["agent"])
        of, lead = movement.column(car["name"]), movement.column(car["agent"]["leader"])
        turn, own = np.exp(1j * movement.yaw[:, lead]), np.exp(1j * movement.yaw[:, of])
        point = x[:, lead] + 1j * y[:, lead] + turn * (slot_x + handle + 1j * slot_y)
        error = (point - x[:, of] - 1j * y[:, of]) / own - handle
        z.append(np.stack([error.real, error.imag], axis=-1))
    return Tracks(movement.time_ns / 1e9, np.stack([x, y, movement.yaw], axis=-1), np.stack(z, axis=1))


def track(scenario: Mapping[str, Any], **more: Any) -> Job:
    """A job that gives `Tracks`."""
    return Job(scenario, partial(tracks, scenario=scenario), **more)


def errors_from(result: Result, scenario: Mapping[str, Any], from_s: float) -> Array:
    """Root mean square of ``|z|`` from ``from_s`` on, m, of each follower, (followers,)."""
    run_tracks = tracks(result, scenario)
    return np.asarray(np.sqrt((run_tracks.error[run_tracks.time_s >= from_s] ** 2).mean(axis=0)))


def rms(scenario: Mapping[str, Any], from_s: float = 20.0, **more: Any) -> Job:
    """A job that gives the root mean square error of each follower, m."""
    return Job(scenario, partial(errors_from, scenario=scenario, from_s=from_s), **more)


def overshoot(z: Array) -> float:
    """Overshoot of a step response (m,) beyond zero, as a share of its start."""
    return float(max(0.0, (-z / z[0]).max()))


def settling_s(time_s: Array, z: Array, band_m: float) -> float:
    """The earliest instant from which ``|z|`` (m,) stays within the band; NaN: never."""
    outside = np.flatnonzero(np.abs(z) > band_m)
    since = int(outside[-1]) + 1 if outside.size else 0
    return float(time_s[since] - time_s[0]) if since < len(z) else math.nan
