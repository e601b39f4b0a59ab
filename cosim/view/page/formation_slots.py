"""Where followers mean to be, as lately told, and how far from it they are."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.page.state import Known


@dataclass(frozen=True)
class Places:
    """The places of those that follow one another.

    Args:
        row: of each follower, (k,).
        place: where it belongs as it is turned now, (k, 3) m, world; at its own height.
        yaw: its own, (k,) rad.
        error_m: the formation error, (k,): see `cosim.types.Follows`.
    """

    row: Array
    place: Array
    yaw: Array
    error_m: Array


def places_of(known: Known) -> Places:
    """The places that are kept at present, of vehicles that are known to be somewhere."""
    kept = [
        (known.row[name], known.row[each.leader], *each.slot, each.handle_m)
        for name, each in known.places.items()
        if name in known.row and each.leader in known.row
    ]
    table = np.array(kept, float).reshape(-1, 5)
    row, leader = table[:, 0].astype(int), table[:, 1].astype(int)
    slot, handle = table[:, 2:4], table[:, 4]
    yaw, own = known.yaw[leader], known.yaw[row]
    ahead, own_ahead = _unit(yaw), _unit(own)
    left = ahead[:, ::-1] * (-1.0, 1.0)
    centre = known.position[leader, :2] + slot[:, :1] * ahead + slot[:, 1:] * left
    here = known.position[row]
    off = here[:, :2] + handle[:, None] * own_ahead - (centre + handle[:, None] * ahead)
    known_both = np.isfinite(off).all(axis=1)
    place = np.column_stack([here[:, :2] - off, here[:, 2]])  # on a curve it is the handles that have to meet
    return Places(*(part[known_both] for part in (row, place, own, np.hypot(off[:, 0], off[:, 1]))))


def _unit(yaw: Array) -> Array:
    return np.column_stack([np.cos(yaw), np.sin(yaw)])
