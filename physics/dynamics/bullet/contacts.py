"""What touches what in a Bullet world, and where."""

from collections.abc import Container, Mapping, Sequence

from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.engine.interface import Touch

_ANY_BODY, _ANY_LINK, _BASE = -1, -2, -1


class Touches:
    """Looks for contacts of vehicles: ``bodies`` are theirs by row, ``others`` have the rows behind them.

    All links count of those in ``jointed``, of others the base alone.
    """

    def __init__(self, client: int, bodies: Mapping[int, int], others: Sequence[int], jointed: Container[int] = ()) -> None:
        self._client, self._bodies = client, bodies
        # Where only the base can touch anything but the floor, the contacts of wheels need not be listed.
        self._links = {row: _ANY_LINK if row in jointed else _BASE for row in bodies}
        self._row_of = {body: row for row, body in bodies.items()}
        self._row_of |= {body: len(bodies) + k for k, body in enumerate(others)}
        self._floor = 0  # the first body of all

    def now(self, rows: Sequence[int]) -> list[Touch]:
        """Contacts of these rows that bear a force in this step, by rows: one for each place."""
        found = []
        for row in rows:
            for contact in p.getContactPoints(self._bodies[row], _ANY_BODY, self._links[row], _ANY_LINK, self._client):
                body, place, force = contact[2], contact[5], contact[9]
                if force <= 0.0 or body == self._floor:
                    continue
                other = self._row_of.get(body)
                if other is None or other > row:
                    found.append(Touch(row, other, place))
                elif other not in rows:  # which would have said so itself
                    found.append(Touch(other, row, place))
        return sorted(found, key=lambda each: each.key)
