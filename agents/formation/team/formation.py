"""The table ``formation = {...}`` of an agent."""

from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.types import NonNegative, Positive

ShapeName = Literal["column", "line", "echelon", "wedge", "box", "diamond", "own"]
TopologyName = Literal["star", "chain", "k-tree", "graph"]
PolicyName = Literal["immediate", "timer", "all-clear"]


class Passage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a team makes itself narrow where its shape is too wide, and when wide again (`agents.formation.team.passage`)."""

    policy: PolicyName = "all-clear"  # becomes wide when the leader's lane is free, is so for a time, or so are those of all
    shape: ShapeName = "column"  # the narrow one
    spacing: Positive | None = None  # m between neighbours in it; default: the formation's
    scanner: str = "scan"  # name of the range scanner that every member looks at
    margin_m: NonNegative = 0.1  # the lane is wider than the wide shape with its bodies, by this on either side
    behind_m: NonNegative = 0.3  # the lane begins so far behind a vehicle
    narrow_m: Positive = 2.0  # the narrow shape is called when something in the leader's lane is nearer than this
    free_m: Positive = 2.5  # that lane is free again when nothing in it is nearer than this
    clear_m: Positive = 1.2  # a member's lane is clear when nothing in it is nearer than this
    timer_s: NonNegative = 3.0  # of "timer": for how long the leader's lane must have been free
    steady_s: NonNegative = 0.5  # of "all-clear": for how long all lanes must have been clear
    member_m: NonNegative = 0.2  # a member is seen no further from where its report puts it, m, besides its radius
    report_s: Positive = 2.5  # what a report older than this says does not count
    silence_s: Positive = 10.0  # a member that has been silent for so long is not waited for
    stale_s: Positive = 0.5  # a scan older than that is none: more than the period of the scanner

    def __post_init__(self) -> None:
        if self.free_m < self.narrow_m:
            raise ValueError(f"passage.free_m = {self.free_m:g} must not be less than narrow_m = {self.narrow_m:g}")
        if self.silence_s <= self.report_s:
            raise ValueError(
                f"passage.silence_s = {self.silence_s:g} must be greater than report_s = {self.report_s:g}: "
                "who is still believed cannot be gone"
            )


class Formation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape and topology of a team."""

    shape: ShapeName = "wedge"  # at the start
    spacing: Positive = 1.0  # m between neighbours
    offsets: tuple[
        tuple[float, float], ...
    ] = ()  # of shape "own": each member's place, x forward, y left, m; the first is [0, 0]
    topology: TopologyName = "star"  # tree of parents over the members
    branching: Annotated[int, msgspec.Meta(ge=1)] = 2  # of topology "k-tree": how many follow each
    parents: Mapping[str, str] | None = None  # of topology "graph": the parent of each member, by name
    members: tuple[str, ...] = ()  # by their places, the first leads; default: all vehicles of the run in their order
    changes: tuple[tuple[NonNegative, ShapeName], ...] = ()  # of the leader: from when on (s) the team takes which shape
    passage: Passage | None = None  # narrow where something is in the way of the shape; default: the leader does not look

    def __post_init__(self) -> None:
        times = [time_s for time_s, _ in self.changes]
        if times != sorted(times):
            raise ValueError(f"changes must be in order of time, not at {', '.join(f'{time_s:g}' for time_s in times)} s")
        if self.passage is not None and self.passage.shape == self.shape:
            raise ValueError(f"passage.shape = {self.shape!r} is the shape of the formation itself; it must be another one")
