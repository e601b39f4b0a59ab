"""Who takes which place of a new shape, so that no two ways cross.

The places are dealt out so that the sum of all ways is least. If two straight ways a -> p and b -> q crossed in a point inside
both, then by the triangle inequality |a q| + |b p| < |a p| + |b q|: exchanging the places would be shorter still. Hence no two
ways of a least sum cross.
"""

from collections.abc import Sequence

import numpy as np

from vcmvsp.agents.formation.team.shape import Slot


def assign(positions: Sequence[Slot], places: Sequence[Slot]) -> tuple[int, ...]:
    """By new place: the number of the member who takes it; the first member, who leads, keeps the first place.

    Args:
        positions: where each member is, m in the leader's frame.
        places: where the new shape wants somebody, as many.
    """
    from scipy.optimize import linear_sum_assignment  # takes long to load, and few teams change shape

    others, wanted = np.array(positions[1:], float).reshape(-1, 2), np.array(places[1:], float).reshape(-1, 2)
    way = np.hypot(*(wanted[:, None, :] - others[None, :, :]).transpose(2, 0, 1))
    _, who = linear_sum_assignment(way)  # rows, here the places, come in their order
    return (0, *(int(member) + 1 for member in who))
