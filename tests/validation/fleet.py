"""Scenarios built in code, a leader and its followers, and what became of them: true poses and errors as arrays."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cosim
from tests.agents.loops import formation_error

Floats = NDArray[np.float64]
Table = Mapping[str, Any]

T, V, W, R, K1 = 0.1, 0.3, 0.15, 2.0, 0.8  # period, s; the leader's speeds, m/s and rad/s, and radius, m; standard gain, 1/s
LEFT = 0.5  # L' of the standard triangle, m: car2 is right-behind (+30 degrees), car3 left-behind
AHEAD = math.cos(math.radians(30.0))  # its L
NEVER_LOST = {"timeout_s": 1e9, "horizon_s": 1e9, "max_reverse": 1e9}  # closed forms know no such rules
RIGHT_BEHIND, LEFT_BEHIND = {"bearing_deg": 30.0}, {"bearing_deg": -30.0}


def fleet(
    duration_s: float,
    followers: Sequence[Table] = (RIGHT_BEHIND, LEFT_BEHIND),
    *,
    path: str = "circle",
    kind: str = "kinematic",
    physics: str = "kinematic",
    vehicles: Table | None = None,
    **tables: Any,
) -> dict[str, Any]:
    """A scenario: car1 leads from the origin, car2, car3, ... follow it 1 m away.

    Args:
        duration_s: how long.
        followers: the agent's parameters of each; a ``pose`` among them is where it starts, by default in its slot.
        path: of the leader.
        kind: of all vehicles.
        physics: kind of physics.
        vehicles: further defaults for all vehicles.
        tables: other tables of the scenario, such as ``radio``.
    """
    cars: list[dict[str, Any]] = [{"name": "car1", "agent": {"kind": "trajectory", "path": path}}]
    for number, given in enumerate(followers, 2):
        bearing = math.radians(given.get("bearing_deg", 0.0))
        pose = given.get("pose", (-math.cos(bearing), -math.sin(bearing), 0.0))
        agent = {"kind": "leader_follower", "leader": "car1", **{k: v for k, v in given.items() if k != "pose"}}
        cars.append({"name": f"car{number}", "pose": pose, "agent": agent})
    return {
        "name": "validation",
        "duration_s": duration_s,
        "seed": 1,
        "physics": {"kind": physics},
        "vehicles": {"kind": kind, **(vehicles or {})},
        "vehicle": cars,
        **tables,
    }


def lossy(probability: float = 0.0, delay_s: float = 0.0, jitter_s: float = 0.0) -> dict[str, Any]:
    """A radio without range or bandwidth that loses and delays."""
    return {
        "preset": "ideal",
        "loss": {"kind": "bernoulli", "probability": probability},
        "delay": {"kind": "fixed", "seconds": delay_s, "jitter_s": jitter_s},
    }


def poses(result: cosim.Result) -> tuple[Floats, Floats]:
    """Recorded times (m,) in s and the true poses (m, vehicles, 3): x m, y m, yaw rad."""
    states = result.states.to_pandas()
    n = states.vehicle.nunique()
    yaw = 2.0 * np.arctan2(states.qz, states.qw)
    columns = np.stack([states.x, states.y, yaw], axis=-1).reshape(-1, n, 3)
    return states.time_ns.to_numpy()[::n] / 1e9, columns


def errors(result: cosim.Result) -> tuple[Floats, Floats]:
    """Recorded times (m,) in s and z (m, followers, 2) in m, each in its follower's frame.

    Computed here from true poses and the last place of each follower: not by the platform's own metrics.
    """
    times, moved = poses(result)
    follows = {placement.vehicle: placement.follows for placement in result._recorder.follows}
    followers = [f"car{number}" for number in range(2, moved.shape[1] + 1)]
    z = [formation_error(moved[:, 0], moved[:, column], follows[name]) for column, name in enumerate(followers, 1)]
    return times, np.stack(z, axis=1)


def files(folder: Path) -> dict[str, bytes]:
    """Everything that a run left and that must not differ between equal runs."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.name != "about.json"}
