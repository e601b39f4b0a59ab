"""What agents say of themselves to those who record, measure and watch, beside what they command and send."""

from vcmvsp.cosim.types.quantities import Array, Value


class Follows(Value, frozen=True, kw_only=True, tag="follows"):
    """The place that a follower means to keep: what the formation error is measured against.

    ``slot`` is where its centre belongs in the leader's frame, (x forward, y left). The error compares the follower's
    handle, ``handle_m`` ahead of its centre, with the point ``slot + (handle_m, 0)`` of the leader's frame.
    """

    leader: str | None  # None: it follows nobody any more
    slot: tuple[float, float] = (0.0, 0.0)  # m
    handle_m: float = 0.0  # m


class Note(Value, frozen=True, kw_only=True, tag="note"):
    """Numbers and words that an agent wants recorded (`Agent.note`)."""

    values: dict[str, float | str | bool]


class ProbabilityMap(Value, frozen=True, kw_only=True, tag="map"):
    """What a vehicle knows of an area that is searched, and what of it it has seen itself; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    probability: Array  # (rows, columns) uint8, of a target in the cell, in 255ths
    seen: Array  # (rows, columns) bool: looked at by this vehicle


class Sighting(Value, frozen=True, kw_only=True):
    """A target that was recognised in a picture."""

    target: str
    place: tuple[float, float]  # m, world, on the ground
    centre_px: tuple[float, float]  # column, row; the middle of the first pixel is (0, 0)
    angle: float  # rad, counter-clockwise in the picture
    side_px: float
    score: float  # 0 to 1


class Sightings(Value, frozen=True, kw_only=True, tag="sightings"):
    """What was recognised in one picture of a camera."""

    sensor: str
    time_ns: int  # when the picture was taken
    width: int  # px
    height: int
    found: tuple[Sighting, ...]
    jpeg: bytes = b""  # the picture itself; empty: not kept


class Mosaic(Value, frozen=True, kw_only=True, tag="mosaic"):
    """The ground as far as a vehicle has seen it, from above; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    pixels: Array  # (rows, columns, 3) uint8, RGB; black: not seen
