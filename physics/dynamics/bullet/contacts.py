"""Contacts in a Bullet world, with their places."""

from collections.abc import Container, Mapping, Sequence

from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.engine.interface import Touch

_ANY_BODY, _ANY_LINK, _BASE = -1, -2, -1
_FLOOR = 0  # the first body of all


class ContactFinder:
    """Finds contacts of vehicles: ``bodies`` of the vehicles by row, ``others`` in the rows behind them.

    Bodies in ``jointed`` count with all links, others with the base alone.
    """

    def __init__(self, client: int, bodies: Mapping[int, int], others: Sequence[int], jointed: Container[int] = ()) -> None:
        self._client, self._bodies = client, bodies
        # Where only the base can touch more than the floor, contacts of wheels need not be listed.
        self._links = {row: _ANY_LINK if row in jointed else _BASE for row in bodies}
        self._row_of = dict(zip(bodies.values(), bodies, strict=True))
        self._row_of |= zip(others, range(len(bodies), len(bodies) + len(others)), strict=True)

    def now(self, rows: Sequence[int]) -> list[Touch]:
        """Contacts of these rows with a force in this step, by rows: one for each place."""
        touches = []
        for row in rows:
            for contact in p.getContactPoints(self._bodies[row], _ANY_BODY, self._links[row], _ANY_LINK, self._client):
                body, place, force = contact[2], contact[5], contact[9]
                if force <= 0.0 or body == _FLOOR:
                    continue
                other = self._row_of.get(body)
                if other is None or other > row:
                    touches.append(Touch(row, other, place))
                elif other not in rows:  # else the row of the other body adds it
                    touches.append(Touch(other, row, place))
        return sorted(touches, key=lambda each: each.key)
