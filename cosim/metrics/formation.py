"""Metrics of formations: errors of followers relative to their own leaders, and their convergence.

Slots lie in the plane: errors in height do not count.

Overshoot and rate of convergence belong to a follower's largest step: among the periods with a constant slot, the one with the
largest initial error. A period that begins within `SETTLED_M` of the slot is no step.

- Overshoot (as in Toh 2012, Figs 30 and 31): the component of z along the start error z0, in the follower's frame, begins
  at |z0|; its largest value below zero as a share of |z0|. Later disturbances of the follower count, too.
- Rate of convergence: the k of ``|z| = |z0| exp(-k t)``, least squares of ln|z| over the recorded instants from the start
  until |z| first falls below 5 % of |z0|, or below twice the error that remains: the RMS |z| of the stretch's last fifth.
  None where that leaves fewer than two instants.

A team is a set of vehicles connected by following at the time. Its shape is the members' centres if all have the same heading:
the slots, added up along the links from the vehicle that follows none (in a ring: from the first in the order of the run).
The shape error of an instant is the distance between centres and shape after the best rotation and translation of the shape
(Kabsch, Acta Crystallographica A32, 1976; in the plane, with centred positions as complex numbers p and d, the rotation is
that of ``sum(conj(d) p)``): root mean square over the members of all teams. Links compare a follower's handle with its
leader's frame; this compares centres with each other, so in turns, where headings differ, the shape bends although the
error of every link is zero.

Notes on obstacle avoidance (modes, shapes of a team, whether the lane ahead of its leader is free) hold from the time of
`cosim.agent.Agent.note` until the next note; the first is no change. The modes ``avoid`` and ``turn`` mean that a vehicle
avoids an obstacle; ``blind`` (standing without sensor data) and a user's own modes do not.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import FOREVER_NS, Motion, Window, between, followers, motion, stretches, window_ns
from vcmvsp.cosim.tables.columns import column, joined, name_column
from vcmvsp.cosim.tables.schema import ERRORS_SCHEMA, Placement, RunFacts, Table, with_facts
from vcmvsp.cosim.types import Array, Follows

SETTLED_M = 0.05  # a follower this near to its slot has settled
ROUNDING_M = 1e-6  # smaller errors are rounding and do not propagate from link to link
ARRIVED = 0.05  # share of |z0|
REMAINS = 2.0  # times the RMS |z| of the last fifth: noise seldom exceeds it
AROUND = ("avoid", "turn")  # modes of obstacle avoidance
FREE = "free"  # value of a lane; any other means narrow

History = Sequence[tuple[int, Any]]  # ns and value; consecutive values differ
Team = tuple[list[int], Array]  # columns of its members, and their slots (k,): x + iy, m


class Noted:
    """History of the notes that count here."""

    def __init__(self) -> None:
        self._histories: dict[tuple[str, str], list[tuple[int, Any]]] = {}

    def take(self, vehicle: str, time_ns: int, values: Mapping[str, Any]) -> None:
        """Record the notes of an agent at a time."""
        for name in ("mode", "shape", "lane"):
            if name in values:
                history = self._histories.setdefault((vehicle, name), [])
                if not history or history[-1][1] != values[name]:
                    history.append((time_ns, values[name]))

    def of(self, vehicle: str, name: str) -> History:
        """History of the values that a vehicle noted under a name."""
        return self._histories.get((vehicle, name), ())


def formation_errors(moved: Motion, follows: Sequence[Placement]) -> dict[str, Array]:
    """``|z|`` (m,) in m of every follower, in the order of the run's vehicles; NaN before it follows a leader."""
    return {name: _length(_offsets(moved, name, follows)) for name in followers(moved.names, follows)}


def errors_table(states: Table, facts: RunFacts) -> pa.Table:
    """The formation error of each follower at each recorded instant at which it follows a vehicle (`ERRORS_SCHEMA`)."""
    moved, follows = motion(states), facts.follows
    time_ns, vehicle, leader, offset = [], [], [], []
    for name in followers(moved.names, follows):
        column_of, offsets = moved.column(name), _offsets(moved, name, follows)
        for span, placed in _parts(moved, name, follows):
            time_ns.append(moved.time_ns[span])
            offset.append(offsets[span] * np.exp(-1j * moved.yaw[span, column_of]))  # into the follower's frame
            vehicle.append(np.full(len(time_ns[-1]), column_of, np.int32))
            leader.append(np.full(len(time_ns[-1]), moved.column(str(placed.leader)), np.int32))
    times, of, by, z = (
        joined(each, (0,), dtype)
        for each, dtype in ((time_ns, np.int64), (vehicle, np.int32), (leader, np.int32), (offset, np.complex128))
    )
    order = np.flatnonzero(np.isfinite(z))
    order = order[np.lexsort((of[order], times[order]))]
    times, of, by, z = times[order], of[order], by[order], z[order]
    names = [name_column(moved.names, each) for each in (of, by)]
    return with_facts([column(times), *names, *map(column, (np.abs(z), z.real, z.imag))], ERRORS_SCHEMA, facts)


def formation_metrics(moved: Motion, follows: Sequence[Placement], window: Window, noted: Noted, end_ns: int) -> dict[str, Any]:
    """The ``formation`` part: RMS, mean, maximum, gain and shape over the window, the others over the whole run."""
    begin, end = window_ns(window)
    inside = (moved.time_ns >= begin) & (moved.time_ns <= end)
    offsets = {name: _offsets(moved, name, follows) for name in followers(moved.names, follows)}
    errors = {name: _length(offset) for name, offset in offsets.items()}
    leads = {name: led_by(name, follows) for name in errors}

    def settled(names: Iterable[str]) -> float | None:
        chosen = [errors[name] for name in names]
        return _settling_s(moved.time_ns, np.array(chosen).reshape(len(chosen), len(moved.time_ns)))

    def changed(names: Collection[str], tellers: Iterable[str]) -> dict[str, Any]:
        teams: dict[str, list[str]] = {}
        for name in names:
            teams.setdefault(leads[name], []).append(name)
        when = {leader: settled(members) for leader, members in teams.items()}
        return {**change_metrics(noted, names, tellers, end_ns), "reformed_s": reformed_s(noted, when)}

    each = {}
    for name, error in errors.items():
        turned = offsets[name] * np.exp(-1j * moved.yaw[:, moved.column(name)])  # into the follower's frame
        steps = [(moved.time_ns[span], turned[span]) for span, _ in _parts(moved, name, follows)]
        overshoot, rate = _response(steps)
        each[name] = {
            **_summary(error[np.newaxis], inside),
            "settling_s": settled([name]),
            "overshoot": overshoot,
            "convergence_1_s": rate,
            "hop_gain": _hop_gain(error, _of_leader(moved, name, follows, errors), inside),
            **changed([name], [name]),
        }
    shape = _summary(shape_errors(moved, follows)[np.newaxis], inside)
    together = np.array(list(errors.values())).reshape(len(errors), len(moved.time_ns))
    return {
        **_summary(together, inside),
        "settling_s": settled(errors),
        "overshoot": max(_numbers(each, "overshoot"), default=None),
        "convergence_1_s": min(_numbers(each, "convergence_1_s"), default=None),
        "hop_gain": max(_numbers(each, "hop_gain"), default=None),
        **changed(errors, leaders(moved.names, follows)),
        "shape": {name: shape[name] for name in ("rms_m", "max_m", "final_m")},
        "per_follower": each,
    }


def _parts(moved: Motion, name: str, follows: Sequence[Placement]) -> list[tuple[slice, Follows]]:
    spans = [(between(moved.time_ns, begin, end), placed) for begin, end, placed in stretches(name, follows)]
    return [(span, placed) for span, placed in spans if placed.leader is not None and span.start < span.stop]


def _offsets(moved: Motion, name: str, follows: Sequence[Placement]) -> Array:
    """``r - h`` (m,) of a follower in the world, m: x + iy; NaN while it follows no vehicle."""
    x, y, _ = moved.position
    offset = np.full(len(moved.time_ns), np.nan, np.complex128)
    f = moved.column(name)
    for span, placed in _parts(moved, name, follows):
        leader, (slot_x, slot_y), ell = moved.column(str(placed.leader)), placed.slot, placed.handle_m
        th_l, th_f = moved.yaw[span, leader], moved.yaw[span, f]
        cos, sin, ahead = np.cos(th_l), np.sin(th_l), slot_x + ell
        offset.real[span] = x[span, leader] + cos * ahead - sin * slot_y - x[span, f] - ell * np.cos(th_f)
        offset.imag[span] = y[span, leader] + sin * ahead + cos * slot_y - y[span, f] - ell * np.sin(th_f)
    return offset


def _length(offset: Array) -> Array:
    return np.asarray(np.hypot(offset.real, offset.imag))


def _of_leader(moved: Motion, name: str, follows: Sequence[Placement], errors: dict[str, Array]) -> Array:
    error = np.full(len(moved.time_ns), np.nan)
    for span, placed in _parts(moved, name, follows):
        if placed.leader in errors:
            error[span] = errors[placed.leader][span]
    return error


def _hop_gain(own: Array, leaders: Array, inside: Array) -> float | None:
    """RMS error of a link over that of its leader's link, where both are measured; None without such links."""
    both = inside & np.isfinite(own) & np.isfinite(leaders)
    below, above = np.sqrt(np.sum(own[both] ** 2)), np.sqrt(np.sum(leaders[both] ** 2))
    return float(below / above) if above > ROUNDING_M * np.sqrt(both.sum()) else None


def _summary(errors: Array, inside: Array) -> dict[str, float | None]:
    """RMS, mean and maximum of errors (followers, m) in the window, and the largest at the last instant."""
    chosen, final = (part[np.isfinite(part)] for part in (errors[:, inside], errors[:, -1:]))
    summary: dict[str, float | None] = dict.fromkeys(("rms_m", "mean_m", "max_m", "final_m"))
    if chosen.size:
        rms, mean, most = np.sqrt(np.mean(chosen**2)), np.mean(chosen), np.max(chosen)
        summary |= {"rms_m": float(rms), "mean_m": float(mean), "max_m": float(most)}
    if final.size:
        summary["final_m"] = float(np.max(final))
    return summary


def _settling_s(time_ns: Array, errors: Array) -> float | None:
    """The first recorded instant from which no error exceeds `SETTLED_M`; an error that ends keeps its last value."""
    measured = np.any(np.isfinite(errors), axis=0)
    instants = np.arange(errors.shape[1])
    last = np.maximum.accumulate(np.where(np.isfinite(errors), instants, 0), axis=1)  # the newest measured instant
    last_errors = np.take_along_axis(errors, last, axis=1)
    unsettled = np.flatnonzero(np.any(last_errors[:, measured] > SETTLED_M, axis=0))
    times = time_ns[measured]
    since = unsettled[-1] + 1 if unsettled.size else 0
    return float(times[since] / SECOND_NS) if since < len(times) else None


def _numbers(each: dict[str, dict[str, Any]], key: str) -> list[float]:
    return [summary[key] for summary in each.values() if summary[key] is not None]


def _response(steps: Sequence[tuple[Array, Array]]) -> tuple[float | None, float | None]:
    """Overshoot and rate (1/s) of the largest step.

    Each step is recorded instants (m,) in ns and the error z (m,) in the follower's frame, m: z1 + i z2; NaN where
    unknown.
    """
    finite_steps = [(time_ns[is_finite], z[is_finite]) for time_ns, z in steps if (is_finite := np.isfinite(z)).any()]
    if not finite_steps:
        return None, None
    time_ns, z = max(finite_steps, key=lambda step: abs(step[1][0]))
    start = abs(z[0])
    if start <= SETTLED_M:
        return None, None
    along = (z * np.conj(z[0])).real / start
    return float(max(0.0, -along.min() / start)), _rate(time_ns, np.abs(z))


def _rate(time_ns: Array, error: Array) -> float | None:
    remains = np.sqrt(np.mean(error[-max(1, len(error) // 5) :] ** 2))
    arrived = np.flatnonzero(error < max(ARRIVED * error[0], REMAINS * remains))
    stop = arrived[0] if arrived.size else len(error)
    if stop < 2:
        return None
    t = (time_ns[:stop] - time_ns[0]) / SECOND_NS
    t -= t.mean()
    return float(-(t @ np.log(error[:stop])) / (t @ t))


def shape_errors(moved: Motion, follows: Sequence[Placement]) -> Array:
    """Shape error (m,) in m of all teams together; NaN without a team."""
    result = np.full(len(moved.time_ns), np.nan)
    places = moved.position[0] + 1j * moved.position[1]
    for span, teams in _eras(moved, follows):
        squared, members = np.zeros(span.stop - span.start), np.zeros(span.stop - span.start)
        for columns, slots in teams:
            own = misfit_squared(places[span, columns], slots)
            is_complete = np.isfinite(own)  # a team that lacks a member does not count
            squared[is_complete] += own[is_complete]
            members[is_complete] += len(columns)
        result[span] = np.sqrt(np.divide(squared, members, out=np.full_like(squared, np.nan), where=members > 0))
    return result


def misfit_squared(places: Array, slots: Array) -> Array:
    """Sum (m,) of squared distances between positions (m, k) and slots (k,) after the best rigid motion; x + iy, m."""
    p, d = places - places.mean(axis=1, keepdims=True), slots - slots.mean()
    turn = p @ np.conj(d)
    size = np.abs(turn)
    turn = np.divide(turn, size, out=np.ones_like(turn), where=size > np.finfo(float).tiny)  # a division by less overflows
    apart = p - turn[:, np.newaxis] * d
    return np.asarray((apart.real**2 + apart.imag**2).sum(axis=1))


def _eras(moved: Motion, follows: Sequence[Placement]) -> Iterator[tuple[slice, list[Team]]]:
    placed: dict[str, Follows] = {}
    times = [*dict.fromkeys(placement.time_ns for placement in follows), FOREVER_NS]
    for (_, changes), (begin, end) in zip(groupby(follows, attrgetter("time_ns")), pairwise(times), strict=True):
        placed.update((change.vehicle, change.follows) for change in changes)
        span = between(moved.time_ns, begin, end)
        if span.start < span.stop:
            yield span, _teams(moved.names, placed)


def _teams(names: Sequence[str], placed: Mapping[str, Follows]) -> list[Team]:
    links: dict[str, list[tuple[str, complex]]] = {name: [] for name in names}
    for follower in names:
        at = placed.get(follower)
        if at is not None and at.leader is not None:
            links[at.leader].append((follower, complex(*at.slot)))
            links[follower].append((at.leader, -complex(*at.slot)))
    leading = [name for name in names if name not in placed or placed[name].leader is None]
    where: dict[str, complex] = {}
    teams = []
    for first in (*leading, *names):  # second pass: members of rings
        if first in where or not links[first]:
            continue
        team, members = {first: 0j}, [first]
        for member in members:  # grows during the loop
            for neighbour, slot in links[member]:
                if neighbour not in team:
                    team[neighbour] = team[member] + slot
                    members.append(neighbour)
        where |= team
        teams.append((list(map(names.index, team)), np.array([*team.values()])))
    return teams


def change_metrics(noted: Noted, vehicles: Iterable[str], tellers: Iterable[str], end_ns: int) -> dict[str, Any]:
    """Number of changes of shape (noted by ``tellers``) and of avoidance mode, and time (s) in those modes.

    The values of modes are None if no vehicle notes a mode.
    """
    modes = [history for name in vehicles if (history := noted.of(name, "mode"))]
    shape_changes = sum(max(0, len(noted.of(name, "shape")) - 1) for name in tellers)
    if not modes:
        return {"shape_changes": shape_changes, "mode_toggles": None, "avoid_s": None}
    steps = [(before, after) for history in modes for (_, before), (_, after) in pairwise(history)]
    spans = [span for history in modes for span in pairwise([*history, (end_ns, None)])]
    away_ns = [end - begin for (begin, mode), (end, _) in spans if mode in AROUND]
    toggles = sum((before in AROUND) != (after in AROUND) for before, after in steps)
    return {"shape_changes": shape_changes, "mode_toggles": toggles, "avoid_s": sum(away_ns) / SECOND_NS}


def leaders(names: Iterable[str], follows: Sequence[Placement]) -> list[str]:
    """Team leaders: vehicles that are followed and never follow."""
    followed = {each.follows.leader for each in follows}
    followed -= {each.vehicle for each in follows}
    return [name for name in names if name in followed]


def led_by(name: str, follows: Sequence[Placement]) -> str:
    """Leader of a follower's team: the last leader of its last leader, and so on upwards."""
    above = {each.vehicle: each.follows.leader for each in follows if each.follows.leader is not None}
    for _ in above:  # bounds the loop if vehicles follow in a ring
        name = above.get(name, name)
    return name


def reformed_s(noted: Noted, settled: Mapping[str, float | None]) -> float | None:
    """Longest time (s) from the leader's lane becoming free until its whole team had settled.

    None if no lane was ever narrow, or if a team has not formed again: its lane stays narrow, a member has not settled
    (``settled``, s, by leader), or the team kept the shape of the narrow lane to the end.
    """
    durations_s = []
    for leader, settled_s in settled.items():
        lane, shapes = noted.of(leader, "lane"), noted.of(leader, "shape")
        if all(state == FREE for _, state in lane):
            continue
        changed_ns = shapes[-1][0] if shapes else -1
        then = [state for time_ns, state in lane if time_ns <= changed_ns]
        if settled_s is None or lane[-1][1] != FREE or (then and then[-1] != FREE):
            return None
        durations_s.append(round(max(0.0, settled_s - lane[-1][0] / SECOND_NS), 9))
    return max(durations_s, default=None)
