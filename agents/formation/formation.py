"""Who keeps which place: what ``formation = {...}`` of an agent says."""

from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec

from cosim.types import NonNegative, Positive

ShapeName = Literal["column", "line", "echelon", "wedge", "box", "diamond", "own"]
TopologyName = Literal["star", "chain", "k-tree", "graph"]


class Formation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A team's shape, and who follows whom in it."""

    shape: ShapeName = "wedge"  # at the start
    spacing: Positive = 1.0  # m between neighbours
    offsets: tuple[
        tuple[float, float], ...
    ] = ()  # of shape "own": each member's place, x forward, y left, m; the first is [0, 0]
    topology: TopologyName = "star"  # who follows whom
    branching: Annotated[int, msgspec.Meta(ge=1)] = 2  # of topology "k-tree": how many follow each
    parents: Mapping[str, str] | None = None  # of topology "graph": whom each member follows, by name
    members: tuple[str, ...] = ()  # by their places, the first leads; default: all vehicles of the run in their order
    changes: tuple[tuple[NonNegative, ShapeName], ...] = ()  # of the leader: from when on (s) the team takes which shape

    def __post_init__(self) -> None:
        times = [time_s for time_s, _ in self.changes]
        if times != sorted(times):
            raise ValueError(f"changes must be in order of time, not at {', '.join(f'{time_s:g}' for time_s in times)} s")
