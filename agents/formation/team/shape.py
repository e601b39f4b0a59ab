"""Shapes and topologies of a formation, and its table ``formation = {...}``.

Slots are centres in the frame of the leader, x forward, y left, m. With spacing s, member i = 0, 1, 2, ... and k = ceil(i / 2):

=========== ==================================================================================================
shape       slot of member i
=========== ==================================================================================================
``column``  ``(-i s, 0)``
``line``    ``(0, (-1)^i k s)``: by turns on the right and on the left of the leader
``echelon`` ``(-i s / sqrt 2, -i s / sqrt 2)``: back to the right
``wedge``   ``(-(sqrt 3 / 2) k s, (-1)^i k s / 2)``: equilateral, by turns right and left; three make the standard triangle
``box``     ``(-(i div m) s, -(i mod m) s)``, m = ceil(sqrt N): rows of m, the leader on the left of the first
``diamond`` rows of 1, 2, ..., m, ..., 2, 1; row r at ``x = -r s / sqrt 2``, its c members at ``y = (c - 1 - 2 j) s / sqrt 2``
``own``     as ``offsets`` say
=========== ==================================================================================================

Of a diamond that is not full, the last places are empty. Neighbours are ``s`` apart in all of them.

A topology is a tree of parents over the places; the root leads:

========== ============================= ================================= =============================================
topology   place i > 0 follows place     depth of N members                what for
========== ============================= ================================= =============================================
``star``   0                             1                                 compact shapes: errors do not propagate
``chain``  i - 1                         N - 1                             columns: all drive the path of the first
``k-tree`` (i - 1) div k                 ceil(log_k(N (k - 1) + 1)) - 1    many members: short ways, no crowd behind one
``graph``  as ``parents`` say, by name   as they say                       anything else
========== ============================= ================================= =============================================

An error takes as many hops to die out as the tree is deep. A place far from its parent has a long lever arm: where the parent
turns at w, the slot moves at w times the distance.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.types import NonNegative, Positive

ShapeName = Literal["column", "line", "echelon", "wedge", "box", "diamond", "own"]
TopologyName = Literal["star", "chain", "k-tree", "graph"]
PolicyName = Literal["immediate", "timer", "all-clear"]


class Passage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a team makes itself narrow where its shape is too wide, and when wide again (`agents.formation.team.passage`)."""

    policy: PolicyName = "all-clear"  # becomes wide when the leader's lane is free, is so for a time, or so are those of all
    shape: ShapeName = "column"  # the narrow one
    spacing: Positive | None = None  # m between neighbours in it; default: the formation's
    scanner: str = "scan"  # name of the range scanner that every member looks at
    margin_m: NonNegative = 0.1  # the lane is wider than the wide shape with its bodies, by this on either side
    behind_m: NonNegative = 0.3  # the lane begins so far behind a vehicle
    narrow_m: Positive = 2.0  # the narrow shape is called when something in the leader's lane is nearer than this
    free_m: Positive = 2.5  # that lane is free again when nothing in it is nearer than this
    clear_m: Positive = 1.2  # a member's lane is clear when nothing in it is nearer than this
    timer_s: NonNegative = 3.0  # of "timer": for how long the leader's lane must have been free
    steady_s: NonNegative = 0.5  # of "all-clear": for how long all lanes must have been clear
    member_m: NonNegative = 0.2  # a member is seen no further from where its report puts it, m, besides its radius
    report_s: Positive = 2.5  # reports older than this are ignored
    silence_s: Positive = 10.0  # a member that has been silent for so long is not waited for
    stale_s: Positive = 0.5  # a scan older than that is none: more than the period of the scanner

    def __post_init__(self) -> None:
        if self.free_m < self.narrow_m:
            raise ValueError(f"passage.free_m = {self.free_m:g} must not be less than narrow_m = {self.narrow_m:g}")
        if self.silence_s <= self.report_s:
            raise ValueError(
                f"passage.silence_s = {self.silence_s:g} must be greater than report_s = {self.report_s:g}: "
                "a member counts as gone only after its reports have expired"
            )


class Formation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape and topology of a team."""

    shape: ShapeName = "wedge"  # at the start
    spacing: Positive = 1.0  # m between neighbours
    # of shape "own": each member's place, x forward, y left, m; the first is [0, 0]
    offsets: tuple[tuple[float, float], ...] = ()
    topology: TopologyName = "star"  # tree of parents over the members
    branching: Annotated[int, msgspec.Meta(ge=1)] = 2  # of topology "k-tree": how many follow each
    parents: Mapping[str, str] | None = None  # of topology "graph": the parent of each member, by name
    members: tuple[str, ...] = ()  # by their places, the first leads; default: all vehicles of the run in their order
    changes: tuple[tuple[NonNegative, ShapeName], ...] = ()  # of the leader: from when on (s) the team takes which shape
    passage: Passage | None = None  # narrow where something is in the way of the shape; default: the leader does not look

    def __post_init__(self) -> None:
        times = [time_s for time_s, _ in self.changes]
        if times != sorted(times):
            raise ValueError(f"changes must be in order of time, not at {', '.join(f'{time_s:g}' for time_s in times)} s")
        if self.passage is not None and self.passage.shape == self.shape:
            raise ValueError(f"passage.shape = {self.shape!r} is also the formation's shape; choose another one")


Slot = tuple[float, float]  # x forward, y left, m
Slots = tuple[Slot, ...]


def slots(shape: ShapeName, count: int, spacing: float, offsets: Sequence[Slot] = ()) -> Slots:
    """Slots of ``count`` members, m in the leader's frame; the first is the leader's own place, (0, 0).

    `ValueError`: ``offsets`` of the shape ``own`` are too few, do not begin with [0, 0], or contain a place twice.
    """
    if shape == "own":
        return _own(count, offsets)
    unit = _unit(shape, count)
    # + 0.0: no negative zeros
    return ((0.0, 0.0), *((spacing * x + 0.0, spacing * y + 0.0) for x, y in unit[1:count]))


def _own(count: int, offsets: Sequence[Slot]) -> Slots:
    points = tuple((float(x), float(y)) for x, y in offsets)
    if len(points) < count:
        raise ValueError(f"shape 'own' needs offsets for all {count} members, not {len(points)}")
    if points[0] != (0.0, 0.0):
        raise ValueError(f"offsets[0] is the leader's place and must be [0, 0], not {list(points[0])}")
    for number, place in enumerate(points):
        if place in points[:number]:
            raise ValueError(f"offsets[{points.index(place)}] and offsets[{number}] are both {list(place)}; change one")
    return points[:count]


def _unit(shape: ShapeName, count: int) -> list[Slot]:
    """The slots of a shape other than "own" with a spacing of 1 m; of a diamond that is not full, also the empty ones."""
    numbers, half, m = range(count), math.sqrt(0.5), 1 + math.isqrt(count - 1)  # m: the least with m m >= count
    by_turns = [((-1.0) ** i, (i + 1) // 2) for i in numbers]  # side and k
    match shape:
        case "column":
            return [(-float(i), 0.0) for i in numbers]
        case "line":
            return [(0.0, side * k) for side, k in by_turns]
        case "echelon":
            return [(-i * half, -i * half) for i in numbers]
        case "wedge":
            return [(-math.sqrt(0.75) * k, side * 0.5 * k) for side, k in by_turns]
        case "box":
            return [(-float(i // m), -float(i % m)) for i in numbers]
    rows = [*range(1, m + 1), *range(m - 1, 0, -1)]
    return [(-r * half, (c - 1 - 2 * j) * half) for r, c in enumerate(rows) for j in range(c)]


ROOT = -1  # the parent of the place that leads


def parents(topology: TopologyName, count: int, branching: int = 2) -> tuple[int, ...]:
    """Parent of each of ``count`` places; ``ROOT`` for the first."""
    if topology == "graph":
        raise ValueError("the topology 'graph' is given by names, not places: use named_parents")
    follow = {"star": count, "chain": 1, "k-tree": branching}[topology]
    return (ROOT, *((i - 1) // follow for i in range(1, count)))


def named_parents(parents: Mapping[str, str], members: Sequence[str]) -> tuple[int, ...]:
    """Number of the parent of each member, from the names in a formation's ``parents``.

    `ValueError`: a name is unknown, a second member has no parent, or the parents form a cycle.
    """
    for name in (*parents, *parents.values()):
        if name not in members:
            raise ValueError(f"formation.parents: {unknown('member', name, members)}")
    first = members[0]
    if first in parents:
        raise ValueError(f"formation.parents: {first} is the first member and leads; it cannot follow {parents[first]}")
    for name in members[1:]:
        if name not in parents:
            raise ValueError(f"formation.parents: {name} has no parent, and only {first} may lead; add a parent for {name}")
    leads_to_first = {first}
    for name in members:
        path = [name]
        while path[-1] not in leads_to_first:
            path.append(parents[path[-1]])
            if path[-1] in path[:-1]:
                circle = path[path.index(path[-1]) :]
                words = ", ".join(f"{follower} follows {leader}" for follower, leader in pairwise(circle))
                raise ValueError(f"formation.parents: {words}: a cycle without a leader")
        leads_to_first.update(path)
    number = {name: each for each, name in enumerate(members)}
    return (ROOT, *(number[parents[name]] for name in members[1:]))


def ancestors(tree: Sequence[int], place: int) -> tuple[int, ...]:
    """The places between a place and the root, nearest first, the root included."""
    path = []
    while (place := tree[place]) != ROOT:
        path.append(place)
    return tuple(path)


@functools.lru_cache(maxsize=16)  # all members of a run use the same
def ranks(tree: tuple[int, ...]) -> tuple[int, ...]:
    """All places, those nearest to the root first: each comes after all its ancestors."""
    return tuple(sorted(range(len(tree)), key=lambda place: (len(ancestors(tree, place)), place)))
