"""A member's view of its formation: own place, parent, present shape.

All members read the same `Formation`, so the start needs no messages. When the leader changes the shape, its reports carry
the new shape, the number of changes and the assignment of places. Every member repeats them in its own reports, so that they
pass down a chain over any lossy link. The highest number counts, from any sender.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import numpy as np

from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import (
    Formation,
    ShapeName,
    Slot,
    Slots,
    ancestors,
    named_parents,
    parents,
    ranks,
    slots,
)
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config.binding import unknown

JUMP = 10_000  # larger increments of ``sn`` are implausible


class Team:
    """The formation from the view of one member.

    The first of all ``members`` leads. ``shape`` is the present one, ``wide`` that outside of passages, ``changed`` the number
    of changes. ``place`` is the number of this member's place, 0 the leader's, and ``slot`` where that is, m in the leader's
    frame. ``parent`` is the vehicle to follow (None: it leads), ``ancestors`` continue up to the leader, and ``ranks`` has all
    places, the nearest to the leader first. ``fields``, shape and places for the own reports, are empty until the shape first
    changes. `ValueError` with the key: the formation does not fit these vehicles.
    """

    def __init__(self, formation: Formation, vehicles: Sequence[str], name: str) -> None:
        self.formation, self.name = formation, name
        self.members = members_of(formation, vehicles, name)
        self.index, count = self.members.index(name), len(self.members)
        self._by_name, narrow = formation.topology == "graph", formation.passage
        if self._by_name:
            self._tree = named_parents(formation.parents or {}, self.members)
        else:
            self._tree = parents(formation.topology, count, formation.branching)
        self._slots = _all_slots(formation, count)
        if narrow is not None:
            _check_narrower(narrow.shape, self._slots[narrow.shape], formation.shape, self._slots[formation.shape])
        self.shape: str = formation.shape
        self.wide: str = formation.shape
        self.changed = 0
        self._coming = [(seconds_to_ns(at_s), shape) for at_s, shape in formation.changes]
        self._order = tuple(range(count))
        self._settle()
        if self.parent is None and (formation.changes or narrow is not None):
            assign(self._slots[self.shape], self._slots[self.shape])  # loads the solver now, not in the middle of a run

    def places(self, shape: str) -> Slots:
        """The slots of a shape, m in the leader's frame."""
        return self._slots[shape]

    def slot_of(self, name: str) -> Slot:
        """Slot of a member, m in the leader's frame."""
        return self._slots[self.shape][self._order.index(self.members.index(name))]

    def beside(self, parent: str) -> Slot:
        """Slot of this member in the frame of another one, m: x forward, y left, as if all had one heading."""
        x, y = self.slot_of(parent)
        return self.slot[0] - x, self.slot[1] - y

    def due(self, now_ns: int) -> list[str]:
        """Scheduled shapes that have become due since the last call."""
        due: list[str] = [shape for at_ns, shape in self._coming if now_ns >= at_ns]
        del self._coming[: len(due)]
        return due

    def take(self, body: Mapping[str, Any]) -> bool:
        """Adopt the shape in a report if it is newer than the own; returns whether it was.

        Invalid content is ignored: a shape that this formation does not have, an order that is no permutation of its members or
        moves the leader, and a number that is newer by more than `JUMP` changes.
        """
        changed = body.get("sn", 0)
        if type(changed) is not int or not self.changed < changed <= self.changed + JUMP:
            return False
        everybody = list(range(len(self.members)))
        shape, order = body.get("shape"), body.get("order", everybody)
        if not isinstance(shape, str) or shape not in self._slots or not isinstance(order, list) or order[:1] != [0]:
            return False
        if any(type(each) is not int for each in order) or sorted(order) != everybody:
            return False
        self._adopt(shape, changed, tuple(order))
        return True

    def change(self, shape: str, positions: Mapping[str, Slot]) -> None:
        """As the leader: change the team's shape, and assign the places with the shortest ways, which do not cross.

        ``positions`` of members are m in the leader's frame; members without a position count as in their places.
        """
        if shape not in self._slots:
            raise ValueError(f"shape = {shape!r}: {unknown('shape', shape, self._slots)}")
        now = [positions.get(name) or self.slot_of(name) for name in self.members]
        self._adopt(shape, self.changed + 1, assign(now, self._slots[shape]))

    def whom(self, alive: Callable[[str], bool]) -> str | None:
        """Vehicle to follow: the nearest living ancestor; None: this member leads now.

        Without a living ancestor, the living member nearest to the leader leads, and the others keep the shape around it. A
        member never follows one that comes later in ``ranks``, so there are no circles.
        """
        for name in self.ancestors:
            if alive(name):
                return name
        return next((name for name in self.ranks[: self.ranks.index(self.name)] if alive(name)), None)

    def _adopt(self, shape: str, changed: int, order: tuple[int, ...]) -> None:
        self.shape, self.changed, self._order = shape, changed, order
        if self.formation.passage is None or shape != self.formation.passage.shape:
            self.wide = shape
        self._settle()

    def _settle(self) -> None:
        self.place = self._order.index(self.index)
        self.slot = self._slots[self.shape][self.place]
        of_node = range(len(self.members)) if self._by_name else self._order  # the member at each node of the tree
        names = [self.members[member] for member in of_node]
        node = self.index if self._by_name else self.place
        self.ancestors = tuple(names[each] for each in ancestors(self._tree, node))
        self.parent = self.ancestors[0] if self.ancestors else None
        self.children = tuple(names[child] for child, parent in enumerate(self._tree) if parent == node)
        self.ranks = tuple(names[each] for each in ranks(self._tree))
        self.fields: dict[str, Any] = {"shape": self.shape, "sn": self.changed} if self.changed else {}
        if self._order != tuple(range(len(self.members))):
            self.fields["order"] = list(self._order)


def _all_slots(formation: Formation, count: int) -> Mapping[str, Slots]:
    narrow, offsets = formation.passage, formation.offsets
    required = {formation.shape, *(shape for _, shape in formation.changes), narrow and narrow.shape}
    spacings = {narrow.shape: narrow.spacing} if narrow is not None and narrow.spacing is not None else {}
    shapes = [shape for shape in get_args(ShapeName) if shape != "own" or "own" in required or offsets]
    return {shape: slots(shape, count, spacings.get(shape, formation.spacing), offsets) for shape in shapes}


def _check_narrower(narrow: str, places: Slots, wide: str, wide_places: Slots) -> None:
    needs, has = (float(np.ptp(each, axis=0)[1]) for each in (places, wide_places))
    if len(places) > 1 and needs >= has:
        raise ValueError(
            f"formation.passage.shape = {narrow!r} is no narrower than the formation's own, {wide!r}: "
            f"{needs:.3g} m instead of {has:.3g} m without bodies; choose another one, or a smaller passage.spacing"
        )


def members_of(formation: Formation, vehicles: Sequence[str], name: str) -> tuple[str, ...]:
    """The formation's members: as listed, else all vehicles; `ValueError`: a name is unknown, repeated or missing."""
    members = formation.members or tuple(vehicles)
    names, used = frozenset(vehicles), set()
    for member in members:
        if member not in names:
            raise ValueError(f"formation.members: {unknown('vehicle', member, vehicles)}")
        if member in used:
            raise ValueError(f"formation.members names {member} twice")
        used.add(member)
    if name not in used:
        raise ValueError(f"formation.members ({', '.join(members)}) does not contain {name}; add it, or remove its formation")
    return members


def assign(positions: Sequence[Slot], places: Sequence[Slot]) -> tuple[int, ...]:
    """Assignment of members to the places of a new shape, in order of places: the numbers of the members.

    The first member, the leader, keeps the first place. The sum of all ways is least, so no two ways cross: if two straight
    ways a -> p and b -> q crossed in a point inside both, then |a q| + |b p| < |a p| + |b q| by the triangle inequality.

    Args:
        positions: of each member, m in the leader's frame.
        places: of the new shape, as many.
    """
    from scipy.optimize import linear_sum_assignment  # takes long to load, and few teams change shape

    others, targets = np.array(positions[1:], float).reshape(-1, 2), np.array(places[1:], float).reshape(-1, 2)
    way = np.hypot(*(targets[:, None, :] - others[None, :, :]).transpose(2, 0, 1))
    _, columns = linear_sum_assignment(way)  # rows, here the places, come in their order
    return (0, *(int(member) + 1 for member in columns))


def check_silence(sending: Sending, formation: Formation | None, heartbeat_s: float | None = None) -> None:
    """Reject (ValueError) a longest silence of a sender that exceeds the time after which it counts as gone."""
    if sending.when == "always":
        return
    if heartbeat_s is not None and heartbeat_s <= sending.silence_s:
        raise ValueError(
            f"heartbeat_s = {heartbeat_s} s must be longer than sending.silence_s = {sending.silence_s} s, "
            "or silent members would count as failed"
        )
    passage = None if formation is None else formation.passage
    if passage is not None and sending.silence_s >= passage.report_s:
        raise ValueError(
            f"sending.silence_s = {sending.silence_s} s must be shorter than formation.passage.report_s = "
            f"{passage.report_s} s, after which a report is ignored"
        )
