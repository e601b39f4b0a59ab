"""Laws of the formation: the lag of followers on a straight line, and the circles on which they follow a leader on a circle."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.formation import SETTLED_M
from vcmvsp.cosim.metrics.window import window_ns
from vcmvsp.cosim.report.law import NORMAL_95, Expected, MeasuredRun
from vcmvsp.cosim.tables.schema import Placement

_SETTLED = 5.0  # time constants of the follower after which its start counts no more
_ROOM = 1.5  # times the leader's speed: what followers must be able to go, so that no limit matters
_LISTED = 8  # followers


def laws(run: MeasuredRun) -> Iterator[Expected]:
    """Those that the scenario's followers obey."""
    followers = [each for each in run.steady if run.agent(each.vehicle).get("kind") == "leader_follower"]
    faulty = any(any(each.values()) for each in run.metrics["agents"].values())
    if not followers or len(followers) < len(run.steady) or faulty:
        return
    yield from _straight(run, followers)
    for each in followers[:_LISTED]:
        yield from _circle(run, each)


def _straight(run: MeasuredRun, followers: list[Placement]) -> Iterator[Expected]:
    """Followers that take each message as it is lag behind by speed times age."""
    leaders, team = {str(each.follows.leader) for each in followers}, [each.vehicle for each in followers]
    first = leaders.pop()
    agents, leader = [run.agent(name) for name in team], run.agent(first)
    gains = {float(agent["k1"]) for agent in agents}
    periods = {float(agent["period_s"]) for agent in (leader, *agents)}
    delay, loss = run.radio["delay"], run.radio["loss"]
    simple = (
        not leaders
        and len(gains) == len(periods) == 1
        and _drives(leader, "straight")
        and "sending" not in leader
        and all((agent.get("estimator"), agent.get("feed")) == ("hold", "parent") for agent in agents)
        and not any("avoidance" in agent or agent["latency_s"] for agent in agents)
        and all(_moves_freely(run, name, _ROOM * float(leader["speed"])) for name in (first, *team))
        and (delay["kind"], delay.get("jitter_s")) == ("fixed", 0.0)
        and loss["kind"] == "bernoulli"
        and loss["probability"] < 1.0
        and set(run.links.losses) <= {"random loss"}
    )
    gain, period, (begin, end) = gains.pop(), periods.pop(), run.window
    if not simple or not 0.0 < gain * period < 2.0 or begin < _SETTLED / gain or run.metrics["formation"]["rms_m"] is None:
        return
    p, speed = float(loss["probability"]), float(leader["speed"])
    age = period * max(1, math.ceil(float(delay["seconds"]) / period - 1e-6))
    mean, rms = closed_forms.lag_behind(speed, gain, period, age, p)
    lasted = min(math.inf if end is None else end, run.metrics["duration_s"]) - begin
    # The age at ticks has the variance T^2 p / (1 - p)^2 and from tick to tick the correlation p.
    ticks = max(1.0, lasted / period) * len(followers)
    spread = NORMAL_95 * speed * period * math.sqrt(p * (1.0 + p) / (1.0 - p) ** 3 / ticks) or None
    found = run.metrics["formation"]
    holds = f"straight at {speed:g} m/s, estimator hold, messages usable after {age:g} s; bodies with inertia differ a little"
    yield Expected("formation error, mean", mean, found["mean_m"], "v (d + T p / (1 - p))", holds, "m", spread)
    yield Expected("formation error, RMS", rms, found["rms_m"], "the same, and its variance", "as above", "m", spread)


def _circle(run: MeasuredRun, placed: Placement) -> Iterator[Expected]:
    """A follower that keeps its place beside a leader on a circle is on a circle of its own."""
    name, at = placed.vehicle, placed.follows
    leader = run.agent(str(at.leader))
    own = run.metrics["formation"]["per_follower"].get(name)
    (ahead, aside), rate = at.slot, float(leader.get("yaw_rate") or 0.0)
    kept = own is not None and own["rms_m"] is not None and own["rms_m"] < SETTLED_M
    if not _drives(leader, "circle") or not kept or not rate:
        return
    if abs(at.handle_m + ahead) > 1e-9:  # the closed form wants the handle beside the leader
        return
    speed = float(leader["speed"])
    _, distance, own_speed = closed_forms.circle(speed / abs(rate), speed, -math.copysign(aside, aside * rate), -ahead)
    measured = _measured(run, name, str(at.leader))
    if measured is None:
        return
    holds = f"{at.leader} drives a circle of {speed / abs(rate):g} m, and {name} is less than 5 cm off its place"
    apart = f"distance of {name} to {at.leader}, mean"
    yield Expected(apart, distance, measured[0], "sqrt(L² + L'² - 2 L L' sin th)", holds, "m")
    yield Expected(f"speed of {name}, mean", own_speed, measured[1], "w sqrt((R + L')² - L²)", "as above", "m/s")


def _moves_freely(run: MeasuredRun, vehicle: str, speed: float) -> bool:
    """Whether a vehicle is simulated, knows where it is, and may be so fast (m/s)."""
    own = run.vehicle(vehicle)
    limits = [table.get("max_speed", math.inf) for table in (own, run.agent(vehicle))]
    return "driver" not in own and own["pose_source"] == "truth" and speed <= min(limits)


def _drives(leader: Mapping[str, Any], path: str) -> bool:
    """Whether a leader drives this path, ahead, and leaves it for nothing."""
    kept = (leader.get("kind"), leader.get("path")) == ("trajectory", path) and "avoidance" not in leader
    return kept and float(leader["speed"]) > 0.0


def _measured(run: MeasuredRun, name: str, leader: str) -> tuple[float, float] | None:
    """Mean distance (m) of two vehicles and mean speed (m/s) of the first, in the window."""
    begin, end = window_ns(run.window)
    inside = (run.moved.time_ns >= begin) & (run.moved.time_ns <= end)
    times = run.moved.time_ns[inside] / SECOND_NS
    if len(times) < 2:
        return None
    own, other = (run.moved.position[:2, inside, run.moved.column(each)] for each in (name, leader))
    way = float(np.hypot(*np.diff(own, axis=1)).sum())
    return float(np.hypot(*(own - other)).mean()), way / float(times[-1] - times[0])
