"""How well teams keep their shapes, wherever they are and whichever way they head.

A team is everybody connected by following at the time. Its shape is where the members' centres belong if all head the same
way: the slots, added up along the links from the one that follows nobody (in a ring: from its first in the order of the
run). The misfit of an instant is what remains between centres and shape after the best rotation and translation of the
shape (Kabsch, Acta Crystallographica A32, 1976; in the plane, with centred positions as complex numbers p and d, the
rotation is that of ``sum(conj(d) p)``): root mean square over the members of all teams.

Links compare a follower's handle with its leader's frame; this compares centres with each other, so in turns, where
headings differ, it shows how the shape bends although every link's error is zero.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from operator import attrgetter

import numpy as np

from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.metrics.window import FOREVER_NS, between
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import Array, Follows

Team = tuple[list[int], Array]  # columns of its members, and where they belong (k,): x + iy, m


def shape_metrics(moved: Motion, follows: Sequence[Placement], inside: Array) -> dict[str, float | None]:
    """RMS and maximum of the misfit over the instants inside the window, and the last one, m."""
    misfit = shape_errors(moved, follows)
    chosen, final = misfit[inside & np.isfinite(misfit)], misfit[-1:]
    final = final[np.isfinite(final)]
    return {
        "rms_m": float(np.sqrt(np.mean(chosen**2))) if chosen.size else None,
        "max_m": float(np.max(chosen)) if chosen.size else None,
        "final_m": float(final[0]) if final.size else None,
    }


def shape_errors(moved: Motion, follows: Sequence[Placement]) -> Array:
    """The misfit (m,) in m of all teams together; NaN while there is none."""
    result = np.full(len(moved.time_ns), np.nan)
    places = moved.position[0] + 1j * moved.position[1]
    for span, teams in _eras(moved, follows):
        squared, members = np.zeros(span.stop - span.start), np.zeros(span.stop - span.start)
        for columns, slots in teams:
            own = misfit_squared(places[span, columns], slots)
            there = np.isfinite(own)  # a team that lacks a member is not judged
            squared[there] += own[there]
            members[there] += len(columns)
        result[span] = np.sqrt(np.divide(squared, members, out=np.full_like(squared, np.nan), where=members > 0))
    return result


def misfit_squared(places: Array, slots: Array) -> Array:
    """Sum (m,) of squared distances between places (m, k) and slots (k,) after the best rigid motion; x + iy, m."""
    p, d = places - places.mean(axis=1, keepdims=True), slots - slots.mean()
    turn = p @ np.conj(d)
    size = np.abs(turn)
    turn = np.divide(turn, size, out=np.ones_like(turn), where=size > 0)
    apart = p - turn[:, np.newaxis] * d
    return np.asarray((apart.real**2 + apart.imag**2).sum(axis=1))


def _eras(moved: Motion, follows: Sequence[Placement]) -> Iterator[tuple[slice, list[Team]]]:
    """The recorded instants between any two changes of places, and the teams of that time."""
    placed: dict[str, Follows] = {}
    times = [*dict.fromkeys(placement.time_ns for placement in follows), FOREVER_NS]
    for (_, changes), (begin, end) in zip(groupby(follows, attrgetter("time_ns")), pairwise(times), strict=True):
        placed.update((change.vehicle, change.follows) for change in changes)
        span = between(moved.time_ns, begin, end)
        if span.start < span.stop:
            yield span, _teams(moved.names, placed)


def _teams(names: Sequence[str], placed: Mapping[str, Follows]) -> list[Team]:
    """Everybody who follows or is followed, by teams; vehicles in the order of the run."""
    links: dict[str, list[tuple[str, complex]]] = {name: [] for name in names}
    for follower in names:
        at = placed.get(follower)
        if at is not None and at.leader is not None:
            links[at.leader].append((follower, complex(*at.slot)))
            links[follower].append((at.leader, -complex(*at.slot)))
    leading = [name for name in names if name not in placed or placed[name].leader is None]
    where: dict[str, complex] = {}
    teams = []
    for first in (*leading, *names):  # the second time round: who follows each other in a ring
        if first in where or not links[first]:
            continue
        where[first], members = 0j, [first]
        for member in members:  # which grows on the way
            for other, slot in links[member]:
                if other not in where:
                    where[other] = where[member] + slot
                    members.append(other)
        teams.append(([names.index(member) for member in members], np.array([where[member] for member in members])))
    return teams
