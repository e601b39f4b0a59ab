"""Theoretical values for a run's report: closed forms of radio and formation that measurements are compared with.

With period T, delay d and independent losses p, messages that arrive are G periods apart, G geometric. The age rises from d by
one second per second, so its mean over time is ``d + T E[G^2] / (2 E[G]) = d + T (1 + p) / (2 (1 - p))``, and that of its peaks
``d + T E[G]`` (`cosim.metrics.age`). For the formation: the lag of followers on a straight line, and their circles behind a
leader on a circle.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.analysis.links import RECEIVED, Links
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.formation import SETTLED_M
from vcmvsp.cosim.metrics.motion import Motion, Window, window_ns
from vcmvsp.cosim.tables.columns import code_of, names_of, numbers
from vcmvsp.cosim.tables.schema import Placement, Recording, Table, blocks_of
from vcmvsp.cosim.types import Array

NORMAL_95 = 1.96
CAUSES = {"bernoulli": "random loss", "gilbert_elliott": "burst"}
_BEHIND = ("script", "trace", "delivery")  # layers behind `loss` that lose frames, too
_EVEN = 0.001  # largest deviation of a vehicle's send period, as a share
_LONGEST = 100_000  # periods: limit of the sums over G
_SETTLED = 5.0  # time constants of the follower after which its start is negligible
_ROOM = 1.5  # ratio of the followers' speed limits to the leader's speed, so that no limit acts
_LISTED = 8  # followers listed


@dataclass(frozen=True)
class Expected:
    """An expected value of a law beside the measured one."""

    quantity: str
    expected: float
    measured: float | None
    law: str
    holds: str  # why the law applies
    unit: str = ""
    spread: float | None = None  # half-width of the 95 % range over runs


@dataclass(frozen=True)
class MeasuredRun:
    """A complete run to compare with theory."""

    scenario: Mapping[str, Any]
    metrics: Mapping[str, Any]
    recording: Recording
    frames: Table
    links: Links
    moved: Motion

    @property
    def radio(self) -> Mapping[str, Any]:
        """The layers of the channel."""
        return self.scenario["radio"]

    @property
    def window(self) -> Window:
        """Evaluation window, s."""
        table = self.scenario["metrics"]
        return table["from_s"], table.get("to_s")

    def vehicle(self, name: str) -> Mapping[str, Any]:
        """Settings of a vehicle, its own table before the defaults."""
        own = {each["name"]: each for each in (*self.scenario["vehicle"], *self.scenario.get("station", ()))}
        return {**self.scenario["vehicles"], **own[name]}

    def agent(self, vehicle: str) -> Mapping[str, Any]:
        """Settings of a vehicle's agent, its own before the defaults."""
        return {**self.scenario["agents"], **self.vehicle(vehicle).get("agent", {})}

    @property
    def steady(self) -> list[Placement]:
        """Slots of the followers if constant over the run; else empty."""
        follows = self.recording.follows
        if len({each.vehicle for each in follows}) < len(follows):
            return []
        return [each for each in follows if each.follows.leader is not None]


def laws(run: MeasuredRun) -> Iterator[Expected]:
    """Expected values of all laws that apply to a run; none for several radios."""
    if isinstance(run.radio, list):
        return
    yield from radio_laws(run)
    yield from motion_laws(run)


def radio_laws(run: MeasuredRun) -> Iterator[Expected]:
    """Expected values of the laws of the scenario's radio."""
    yield from _losses(run)
    yield from _delay(run)
    if "routing" not in run.scenario:  # a relayed message has more than one chance
        yield from _age(run)


def _losses(run: MeasuredRun) -> Iterator[Expected]:
    loss = run.radio["loss"]
    cause = CAUSES.get(loss["kind"])
    if cause is None or any(run.radio[layer]["kind"] != "none" for layer in _BEHIND):
        return
    lost = run.links.losses.get(cause, np.zeros_like(run.links.sent))
    passed = int(run.links.received.sum())
    n = passed + int(lost.sum())
    if not n:
        return
    measured = float(lost.sum()) / n
    if loss["kind"] == "bernoulli":
        p = float(loss["probability"])
        if p > 0.0:
            spread = NORMAL_95 * math.sqrt(p * (1.0 - p) / n)
            yield Expected(
                "share of frames lost by chance", p, measured, "p", f"radio.loss takes each of {n} on its own", "", spread
            )
        return
    to_bad, to_good, bad, good = (float(loss[key]) for key in ("to_bad_per_s", "to_good_per_s", "bad_loss", "good_loss"))
    rate, share = to_bad + to_good, to_bad / (to_bad + to_good)
    p = share * bad + (1.0 - share) * good
    times = rate * float(run.metrics["duration_s"])  # number of independent draws of the state
    states = share * (1.0 - share) * (bad - good) ** 2 * 2.0 / times * (1.0 - (1.0 - math.exp(-times)) / times)
    frames = (share * bad * (1.0 - bad) + (1.0 - share) * good * (1.0 - good)) / n
    reached = run.links.received + lost
    uneven = float(((reached / reached.sum()) ** 2).sum())  # 1 over the number of links, if all carry the same traffic
    yield Expected(
        "share of frames lost in bursts",
        p,
        measured,
        "(p bad_loss + r good_loss) / (p + r)",
        f"links are bad and good by turns, each of {int((reached > 0).sum())} on its own",
        "",
        NORMAL_95 * math.sqrt(states * uneven + frames),
    )


def _delay(run: MeasuredRun) -> Iterator[Expected]:
    bounds, measured = _bounds_s(run), run.metrics["radio"]["delay_s"]["mean"]
    if bounds is None or measured is None:
        return
    low, high = bounds
    spread = NORMAL_95 * (high - low) / math.sqrt(12.0 * int(run.links.received.sum()))
    law = "seconds" if low == high else "the middle of the range"
    yield Expected("delay, mean", 0.5 * (low + high), measured, law, "no frame waits so long for the air", "s", spread or None)


def _age(run: MeasuredRun) -> Iterator[Expected]:
    period_s, ages, d = _sending_period_s(run), run.metrics["radio"]["age_s"], run.metrics["radio"]["delay_s"]["mean"]
    loss, links = run.radio["loss"], _counted(run)
    if period_s is None or d is None or loss["kind"] not in ("bernoulli", "none") or ages.get("time_average") is None:
        return
    p = float(loss.get("probability", 0.0))
    others = sum(int(lost[links].sum()) for cause, lost in run.links.losses.items() if cause != CAUSES["bernoulli"])
    range_s = _range_s(run)
    if others or p >= 1.0 or range_s is None or range_s[1] - range_s[0] > period_s:  # messages may overtake each other
        return
    begin, end = run.window
    lasted = min(math.inf if end is None else end, run.metrics["duration_s"]) - begin
    n = max(1.0, lasted / period_s * (1.0 - p)) * int(links.sum())  # approximate number of receptions in the window
    mean_gap, area_sd, gap_sd = _renewal(p)
    holds = f"each sends every {period_s:g} s, and only chance takes messages; d is the measured mean delay"
    spread = [NORMAL_95 * sd * period_s / math.sqrt(n) or None for sd in (area_sd, gap_sd)]
    mean = d + period_s * (1.0 + p) / (2.0 * (1.0 - p))
    yield Expected(
        "age of information, over all time", mean, ages["time_average"], "d + T (1 + p) / (2 (1 - p))", holds, "s", spread[0]
    )
    yield Expected(
        "age of information, peaks", d + period_s * mean_gap, ages["peak"], "d + T / (1 - p)", "as above", "s", spread[1]
    )


def _renewal(p: float) -> tuple[float, float, float]:
    """For gaps G in periods: mean; roots of n times the variance, over n gaps, of the mean age and of the mean gap."""
    g = np.arange(1.0, min(_LONGEST, 2.0 + (40.0 / -math.log(p) if p > 0.0 else 0.0)))
    share = (1.0 - p) * p ** (g - 1.0)
    mean, square = float(share @ g), float(share @ g**2)
    area = 0.5 * g**2 - 0.5 * square / mean * g  # the mean age is a ratio of sums: delta method
    return mean, math.sqrt(float(share @ area**2)) / mean, math.sqrt(max(0.0, square - mean**2))


def _range_s(run: MeasuredRun) -> tuple[float, float] | None:
    """Range of the uniform delay layer; None for other layers, or if a script or a trace adds delay."""
    scripted = any("delay_s" in change for change in run.radio["script"].get("changes", ()))
    if scripted or run.radio["trace"]["kind"] != "none":
        return None
    delay = run.radio["delay"]
    if delay["kind"] == "none":
        return 0.0, 0.0
    if delay["kind"] == "fixed":
        return float(delay["seconds"] - delay["jitter_s"]), float(delay["seconds"] + delay["jitter_s"])
    return (float(delay["from_s"]), float(delay["to_s"])) if delay["kind"] == "uniform" else None


def _bounds_s(run: MeasuredRun) -> tuple[float, float] | None:
    """Range of the delay if the delay layer alone determines it; else None."""
    range_s = _range_s(run)
    if range_s is None:
        return None
    behind = run.radio["delivery"]["kind"] != "none"
    if behind or not run.links.received.any() or range_s[0] * SECOND_NS < _longest_before_delay_ns(run.frames):
        return None
    return range_s


def _longest_before_delay_ns(radio: Table) -> int:
    """Longest time that a received frame spent in the queue, in access to the medium and on the air."""
    longest, parts = 0, ("queue_ns", "access_ns", "air_time_ns")
    for block in blocks_of(radio, ("outcome", *parts)):
        outcomes, outcome = names_of(block, "outcome")
        spent = sum(numbers(block, name) for name in parts)
        longest = max(longest, int(np.max(spent, where=outcome == code_of(outcomes, RECEIVED), initial=0)))
    return longest


def _counted(run: MeasuredRun) -> Array:
    """Links (n, n) whose ages count: leader to follower; without followers, all links to vehicles with an agent."""
    names = run.links.names
    chosen = np.zeros((len(names), len(names)), np.bool_)
    if not run.recording.follows:
        chosen[:, [names.index(each) for each in run.metrics["agents"]]] = True
        return np.asarray(chosen & (run.links.sent > 0))
    for each in run.steady:
        chosen[names.index(str(each.follows.leader)), names.index(each.vehicle)] = True
    return chosen


def _sending_period_s(run: MeasuredRun) -> float | None:
    links, times, periods = _counted(run), _sent_ns(run.frames), set()
    for sender in np.flatnonzero(links.any(axis=1)).tolist():
        sent = np.unique(np.concatenate(times.get(run.links.names[sender], [np.empty(0, np.int64)])))
        if len(sent) < 3:
            return None
        gaps = np.diff(sent)
        period = float(np.median(gaps))
        if np.abs(gaps - period).max() > _EVEN * period:
            return None
        periods.add(round(period / SECOND_NS, 6))
    return periods.pop() if len(periods) == 1 else None


def _sent_ns(radio: Table) -> dict[str, list[Array]]:
    """Sending times of each sender, in parts."""
    times_of: dict[str, list[Array]] = {}
    for block in blocks_of(radio, ("sender", "sent_ns")):
        names, by = names_of(block, "sender")
        times = numbers(block, "sent_ns")
        first = np.flatnonzero(np.diff(by, prepend=-1) | np.diff(times, prepend=-1))  # the rows of a frame are adjacent
        by, times = by[first], times[first]
        for code in np.flatnonzero(np.bincount(by)).tolist():
            times_of.setdefault(names[code], []).append(times[by == code])
    return times_of


def motion_laws(run: MeasuredRun) -> Iterator[Expected]:
    """Expected values of the laws of the scenario's followers."""
    followers = [each for each in run.steady if run.agent(each.vehicle).get("kind") == "leader_follower"]
    faulty = any(any(each.values()) for each in run.metrics["agents"].values())
    if not followers or len(followers) < len(run.steady) or faulty:
        return
    yield from _straight(run, followers)
    for each in followers[:_LISTED]:
        yield from _circle(run, each)


def _straight(run: MeasuredRun, followers: list[Placement]) -> Iterator[Expected]:
    leaders = {str(each.follows.leader) for each in followers}
    team = [each.vehicle for each in followers]
    first = leaders.pop()
    agents, leader = list(map(run.agent, team)), run.agent(first)
    gains = {float(agent["k1"]) for agent in agents}
    periods = {float(agent["period_s"]) for agent in (leader, *agents)}
    delay, loss = run.radio["delay"], run.radio["loss"]
    are_free = (_moves_freely(run, name, _ROOM * float(leader["speed"])) for name in (first, *team))
    simple = (
        not leaders
        and len(gains) == len(periods) == 1
        and _drives(leader, "straight")
        and "sending" not in leader
        and all(map(_holds_reports, agents))
        and all(are_free)
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
    formation = run.metrics["formation"]
    holds = f"straight at {speed:g} m/s, estimator hold, messages usable after {age:g} s; bodies with inertia differ a little"
    yield Expected("formation error, mean", mean, formation["mean_m"], "v (d + T p / (1 - p))", holds, "m", spread)
    yield Expected("formation error, RMS", rms, formation["rms_m"], "the same, and its variance", "as above", "m", spread)


def _circle(run: MeasuredRun, placed: Placement) -> Iterator[Expected]:
    name, at = placed.vehicle, placed.follows
    leader = run.agent(str(at.leader))
    own = run.metrics["formation"]["per_follower"].get(name)
    (ahead, aside), rate = at.slot, float(leader.get("yaw_rate") or 0.0)
    is_settled = own is not None and own["rms_m"] is not None and own["rms_m"] < SETTLED_M
    if not _drives(leader, "circle") or not is_settled or not rate:
        return
    if abs(at.handle_m + ahead) > 1e-9:  # the closed form needs the handle beside the leader
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


def _holds_reports(agent: Mapping[str, Any]) -> bool:
    """Whether a follower only holds its leader's reports, and acts on them at once."""
    law = agent.get("estimator"), agent.get("feed")
    return law == ("hold", "parent") and "avoidance" not in agent and not agent["latency_s"]


def _moves_freely(run: MeasuredRun, vehicle: str, speed: float) -> bool:
    own = run.vehicle(vehicle)
    limits = [table.get("max_speed", math.inf) for table in (own, run.agent(vehicle))]
    return "driver" not in own and own["pose_source"] == "truth" and speed <= min(limits)


def _drives(leader: Mapping[str, Any], path: str) -> bool:
    holds = (leader.get("kind"), leader.get("path")) == ("trajectory", path) and "avoidance" not in leader
    return holds and float(leader["speed"]) > 0.0


def _measured(run: MeasuredRun, name: str, leader: str) -> tuple[float, float] | None:
    begin, end = window_ns(run.window)
    inside = (run.moved.time_ns >= begin) & (run.moved.time_ns <= end)
    times = run.moved.time_ns[inside] / SECOND_NS
    if len(times) < 2:
        return None
    own, other = (run.moved.position[:2, inside, run.moved.column(each)] for each in (name, leader))
    way = float(np.hypot(*np.diff(own, axis=1)).sum())
    return float(np.hypot(*(own - other)).mean()), way / float(times[-1] - times[0])
