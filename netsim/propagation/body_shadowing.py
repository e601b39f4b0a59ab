"""Attenuation by the bodies of vehicles between sender and receiver."""

from typing import NamedTuple

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Ints

_NEVER_ZERO = 1e-300  # added to what is divided by: changes nothing but a zero


class Bodies(NamedTuple):
    """Upright cylinders, m of them."""

    foot: Floats  # (m, 3) middle of the lower end, m, world
    radius_m: Floats  # (m,)
    height_m: Floats  # (m,)
    loss_db: Floats  # (m,) of a link that passes through


def through(bodies: Bodies, sender: int, antennas: Floats) -> tuple[Floats, Ints]:
    """Attenuation of the links of one sender by the bodies of third vehicles.

    Args:
        bodies: one for each vehicle.
        sender: its row.
        antennas: of all vehicles, (m, 3) m, world.

    Returns:
        Loss in dB and number of bodies on the straight line to each other vehicle, (m - 1,) each, in the order of the rows.
    """
    crossed = _crossed(bodies, antennas[sender], antennas)
    np.fill_diagonal(crossed, val=False)  # no vehicle blocks its own links
    crossed[:, sender] = False
    crossed = np.delete(crossed, sender, axis=0) & (bodies.loss_db > 0.0)
    return np.where(crossed, bodies.loss_db, 0.0).sum(axis=1), crossed.sum(axis=1)


def _crossed(bodies: Bodies, tx: Floats, rx: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which lines from ``tx`` to ``rx`` (n, 3) pass through which bodies, (n, m).

    Seen from above a body is a disc: the line is inside it between two fractions of its length. It passes through the body if
    it is at its height somewhere between. Counted from the middle of the line, so that there and back are the same.
    """
    middle, run = 0.5 * (tx + rx)[:, None], (rx - tx)[:, None]
    x, y = (middle - bodies.foot)[..., 0], (middle - bodies.foot)[..., 1]
    dx, dy, dz = run[..., 0], run[..., 1], run[..., 2]
    squared = dx * dx + dy * dy + _NEVER_ZERO
    nearest = -(x * dx + y * dy) / squared
    inside = bodies.radius_m**2 - (x * dy - y * dx) ** 2 / squared  # of the disc, squared distance to its edge
    half = np.sqrt(np.maximum(inside, 0.0) / squared)
    enter, leave = np.maximum(nearest - half, -0.5), np.minimum(nearest + half, 0.5)
    ends = np.stack([middle[..., 2] + enter * dz, middle[..., 2] + leave * dz]) - bodies.foot[:, 2]
    touches = (ends.max(axis=0) > 0.0) & (ends.min(axis=0) < bodies.height_m)
    crossed: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (inside > 0.0) & (leave > enter) & touches
    return crossed
