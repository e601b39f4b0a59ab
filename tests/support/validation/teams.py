"""Scenarios of teams built in code, and each member's error against its slot at the time."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

import vcmvsp
from tests.support.agents.agent_loop import formation_error
from tests.support.validation.fleets import Floats, Table, poses
from vcmvsp.agents.formation.team.shape import slots
from vcmvsp.cosim.reproduction.figures.scenarios import IDEAL

COLUMN = {"shape": "column", "topology": "chain", "spacing": 0.8}


def team(
    count: int,
    duration_s: float,
    formation: Table,
    *,
    leader: Table | None = None,
    kind: str = "kinematic",
    lead_kind: str = "kinematic",
    agents: Table | None = None,
    **tables: Any,
) -> dict[str, Any]:
    """A scenario: car1 leads, car2, car3, ... start in their slots.

    Args:
        count: of vehicles, the leader included.
        duration_s: of the run.
        formation: of all.
        leader: parameters of its trajectory; default: the circle.
        kind: of the followers.
        lead_kind: of the leader.
        agents: further parameters of all.
        tables: other tables of the scenario, such as ``radio``.
    """
    places = slots(formation["shape"], count, formation.get("spacing", 1.0))
    cars: list[dict[str, Any]] = [{"name": "car1", "kind": lead_kind, "agent": {"kind": "trajectory", **(leader or {})}}]
    for number, place in enumerate(places[1:], 2):
        cars.append({"name": f"car{number}", "kind": kind, "pose": (*place, 0.0), "agent": {"kind": "leader_follower"}})
    return {
        "name": "validation",
        "duration_s": duration_s,
        "seed": 1,
        "physics": {"kind": "kinematic"},
        "agents": {"formation": dict(formation), **(agents or {})},
        "vehicle": cars,
        "radio": IDEAL,
        **tables,
    }


def link_errors(result: vcmvsp.Result) -> tuple[Floats, dict[str, Floats]]:
    """Recorded times (m,) in s and |z| (m,) in m of every follower against its parent at the time; NaN while it led.

    Computed here from true poses and the recorded slots: not by the platform's own metrics.
    """
    times, moved = poses(result)
    names = [f"car{number}" for number in range(1, moved.shape[1] + 1)]
    ns = np.round(times * 1e9)
    errors: dict[str, Floats] = {}
    for placed in result.follows:
        error = errors.setdefault(placed.vehicle, np.full(len(times), np.nan))
        since = ns >= placed.time_ns
        if placed.follows.leader is None:
            error[since] = np.nan
            continue
        parent, own = moved[since, names.index(placed.follows.leader)], moved[since, names.index(placed.vehicle)]
        error[since] = np.hypot(*formation_error(parent, own, placed.follows).T)
    return times, errors


def rms_of_links(result: vcmvsp.Result) -> list[float]:
    """RMS of |z| over the window of the metrics, m, by follower."""
    return [each["rms_m"] for each in result.metrics["formation"]["per_follower"].values()]


def parents_of(result: vcmvsp.Result) -> Mapping[str, list[tuple[float, str | None]]]:
    """Parents of each follower, with the time, s, from which each applies."""
    followed: dict[str, list[tuple[float, str | None]]] = {}
    for placed in result.follows:
        followed.setdefault(placed.vehicle, []).append((placed.time_ns / 1e9, placed.follows.leader))
    return followed


def neighbours_only(count: int, probability: float = 0.0) -> dict[str, Any]:
    """A radio in which only neighbours in the column receive each other, with losses."""
    cut = [f"car{a}/car{b}" for a in range(1, count + 1) for b in range(1, count + 1) if abs(a - b) > 1]
    return {
        "preset": "ideal",
        "loss": {"kind": "bernoulli", "probability": probability},
        "script": {"kind": "script", "changes": [{"from_s": 0.0, "links": cut, "loss": 1.0}]},
    }


def oscillation(result: vcmvsp.Result, omega: float) -> Floats:
    """Complex amplitudes (vehicles,) of the motion along x at ``omega``, rad/s, m, over its last whole period."""
    times, moved = poses(result)
    last = times >= times[-1] - math.tau / omega
    t = times[last]
    basis = np.stack([np.ones_like(t), t, np.cos(omega * t), np.sin(omega * t)], axis=1)
    _, _, cosine, sine = np.linalg.lstsq(basis, moved[last, :, 0], rcond=None)[0]
    return np.asarray(cosine - 1j * sine)
