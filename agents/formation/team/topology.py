"""Topologies: trees of parents over the places of a formation; the root leads.

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
from collections.abc import Mapping, Sequence
from itertools import pairwise

from vcmvsp.agents.formation.team.formation import TopologyName
from vcmvsp.cosim.config.binding import unknown

ROOT = -1  # the parent of the place that leads


def parents(topology: TopologyName, count: int, branching: int = 2) -> tuple[int, ...]:
    """The place that each of ``count`` places follows; ``ROOT`` for the first."""
    if topology == "star":
        return (ROOT, *(0 for _ in range(1, count)))
    if topology == "chain":
        return (ROOT, *range(count - 1))
    if topology == "k-tree":
        return (ROOT, *((i - 1) // branching for i in range(1, count)))
    raise ValueError("the topology 'graph' follows names, not places: see named_parents")


def named_parents(parents: Mapping[str, str], members: Sequence[str]) -> tuple[int, ...]:
    """Number of the parent of each member, from the names in a formation's ``parents``.

    Raises:
        ValueError: an unknown name, a second member without a parent, or a cycle.
    """
    for name in (*parents, *parents.values()):
        if name not in members:
            raise ValueError(f"formation.parents: {unknown('member', name, members)}")
    first = members[0]
    if first in parents:
        raise ValueError(f"formation.parents: {first} is the first member and leads; it cannot follow {parents[first]}")
    for name in members[1:]:
        if name not in parents:
            raise ValueError(f"formation.parents: {name} follows nobody, but {first} leads already; say whom {name} follows")
    leads_to_first = {first}
    for name in members:
        path = [name]
        while path[-1] not in leads_to_first:
            path.append(parents[path[-1]])
            if path[-1] in path[:-1]:
                circle = path[path.index(path[-1]) :]
                words = ", ".join(f"{one} follows {other}" for one, other in pairwise(circle))
                raise ValueError(f"formation.parents: {words}: a circle, which nobody leads")
        leads_to_first.update(path)
    number = {name: each for each, name in enumerate(members)}
    return (ROOT, *(number[parents[name]] for name in members[1:]))


def ancestors(tree: Sequence[int], place: int) -> tuple[int, ...]:
    """The places between a place and the root, nearest first, the root included."""
    path = []
    while (place := tree[place]) != ROOT:
        path.append(place)
    return tuple(path)


def depth(tree: Sequence[int]) -> int:
    """How many hops the farthest place is from the root."""
    return max(len(ancestors(tree, place)) for place in range(len(tree)))


@functools.lru_cache(maxsize=16)  # all members of a run ask for the same
def ranks(tree: tuple[int, ...]) -> tuple[int, ...]:
    """All places, those nearest to the root first: each comes after all its ancestors."""
    return tuple(sorted(range(len(tree)), key=lambda place: (len(ancestors(tree, place)), place)))
