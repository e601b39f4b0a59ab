"""What touches what in a Bullet world, with the solid that a place on the one mesh belongs to."""

from collections.abc import Container, Mapping, Sequence

import numpy as np

from cosim.types import Vec3
from physics.bullet import p
from physics.engine import Touch
from physics.world import World

_ANY_BODY, _ANY_LINK, _BASE = -1, -2, -1
_PLACE_M = 0.05  # how far off its surface a contact's place may lie


class Touches:
    """Looks for contacts of vehicles: ``bodies`` are theirs by row, ``others`` have the rows behind them.

    All links count of those in ``jointed``, of others the base alone.
    """

    def __init__(
        self, client: int, world: World, bodies: Mapping[int, int], others: Sequence[int], jointed: Container[int] = ()
    ) -> None:
        self._client, self._world, self._bodies = client, world, bodies
        # Where only the base can touch anything but the floor, the contacts of wheels need not be listed.
        self._links = {row: _ANY_LINK if row in jointed else _BASE for row in bodies}
        self._row_of = {body: row for row, body in bodies.items()}
        self._row_of |= {body: len(bodies) + k for k, body in enumerate(others)}
        self._floor = 0  # the first body of all

    def now(self, rows: Sequence[int]) -> list[Touch]:
        """Contacts of these rows that bear a force in this step, by rows: one for each pair of bodies, and for each solid."""
        found: dict[tuple[int, int, int], Touch] = {}
        for row in sorted(rows):
            for contact in p.getContactPoints(self._bodies[row], _ANY_BODY, self._links[row], _ANY_LINK, self._client):
                body, place, force = contact[2], contact[5], contact[9]
                if force <= 0.0 or body == self._floor:
                    continue
                other = self._row_of.get(body)
                if other is None:
                    touch = Touch(row, None, place, solid_at(self._world, place))
                else:
                    touch = Touch(min(row, other), max(row, other), place)
                found.setdefault(touch.key, touch)
        return [found[key] for key in sorted(found)]


def solid_at(world: World, place: Vec3) -> int | None:
    """The number of the solid whose surface a place lies on or near to, the nearest; None: there is none."""
    nearest, best = None, _PLACE_M
    x, y, z = place
    for group in world.shapes.groups:
        edges = np.roll(group.corners, -1, axis=1) - group.corners
        normals = np.stack([edges[..., 1], -edges[..., 0]], axis=-1) / np.hypot(edges[..., 0], edges[..., 1])[..., None]
        beyond = (normals * (np.array([x, y]) - group.corners)).sum(axis=2).max(axis=1)
        off = np.abs(np.maximum(beyond, np.maximum(group.bottom - z, z - group.top)))  # of the surface, in or out
        k = int(off.argmin())
        if off[k] < best:
            nearest, best = int(group.solid[k]), float(off[k])
    triangles = world.shapes.triangles
    if nearest is None and len(triangles):
        low, high = triangles.min(axis=1) - _PLACE_M, triangles.max(axis=1) + _PLACE_M
        inside = ((low <= place) & (np.array(place) <= high)).all(axis=1)
        if inside.any():
            normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            lengths = np.maximum(np.sqrt((normals * normals).sum(axis=1)), 1e-30)
            off = np.abs((normals * (np.array(place) - triangles[:, 0])).sum(axis=1)) / lengths
            nearest = int(world.shapes.triangle_solid[int(np.where(inside, off, np.inf).argmin())])
    return nearest
