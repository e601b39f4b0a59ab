"""Straight paths in the plane."""

import math

from vcmvsp.agents.formation.team.shape import Slot


def crosses(a: Slot, p: Slot, b: Slot, q: Slot) -> bool:
    """Whether the paths a -> p and b -> q cross in a point inside both, neither along the other."""

    def side(o: Slot, u: Slot, w: Slot) -> float:
        """Signed distance of w from the line through o and u."""
        return ((u[0] - o[0]) * (w[1] - o[1]) - (u[1] - o[1]) * (w[0] - o[0])) / math.dist(o, u)

    if a == p or b == q:
        return False
    ends = side(a, p, b), side(a, p, q), side(b, q, a), side(b, q, p)
    margin = 1e-6  # m: touching is not crossing
    return min(map(abs, ends)) > margin and ends[0] * ends[1] < 0 and ends[2] * ends[3] < 0
