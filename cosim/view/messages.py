"""Messages between a run, or a recording, and the control station.

`Scenery` is sent once and holds constant data; `PageUpdate` follows at most thirty times a second; `Order` carries user input
from the station. A recording uses the same three messages.
"""

from collections.abc import Mapping
from typing import Literal, Self

import numpy as np

from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.scenario.schema import InterventionTable
from vcmvsp.cosim.types import (
    Array,
    Fix,
    Follows,
    FrameReport,
    Image,
    Mosaic,
    Presence,
    ProbabilityMap,
    RealStatus,
    Scan,
    Sightings,
    States,
    Value,
    Vec3,
    frozen,
)

Pose = tuple[float, float, float, float]
"""x, y, z m and yaw rad, world."""


class Lens(Value, frozen=True, kw_only=True):
    """Where a camera looks."""

    mount: Vec3  # of its pinhole, m, in the vehicle's frame
    body_from_camera: tuple[
        Vec3, Vec3, Vec3
    ]  # rows of the rotation; the camera's z axis is the optical axis, its y axis points down in the picture
    field_of_view: float  # vertical, rad
    aspect: float  # width by height


class Craft(Value, frozen=True, kw_only=True):
    """A vehicle as the page shows it."""

    name: str
    kind: str  # as in the scenario
    size: Vec3  # of its body, m: along, across, up
    offset: Vec3 = (0.0, 0.0, 0.0)  # of the centre of its body from its reference point, m, in its own frame
    flies: bool = False
    real: bool = False
    agent: str = ""  # kind of its agent; empty: no agent
    period_s: float | None = None  # between its agent's ticks
    sensors: Mapping[str, str] = {}  # name -> kind; can be requested with a `Sensors` order
    cameras: Mapping[str, Lens] = {}  # by the names of these sensors
    shape: str = ""  # name of its shape in `Scenery.shapes`; empty: that of its kind


class Obstacle(Value, frozen=True, kw_only=True):
    """A solid that can be moved or moves by itself."""

    name: str
    shape: Literal["box", "cylinder"]
    size: Vec3  # m; of a cylinder: its diameter twice, and its height
    pose: Pose  # of its centre, at the start
    color: tuple[int, int, int]
    may_be_moved: bool = False  # by the user


class Floor(Value, frozen=True, kw_only=True):
    """Picture of the floor, as cameras see it."""

    pixels: Array  # (h, w, 3) uint8, RGB; row 0 is the north edge
    center: tuple[float, float]  # m
    size: tuple[float, float]  # east-west and north-south, m


class ShapePart(Value, frozen=True, kw_only=True):
    """Triangles of one colour, in the vehicle's frame."""

    triangles: Array  # (t, 3, 3) float32 m, counter-clockwise seen from outside
    color: tuple[int, int, int]


class Scenery(Value, frozen=True, kw_only=True):
    """Constant data of a run."""

    scenario: str
    seed: int
    duration_ns: int
    vehicles: tuple[Craft, ...]
    vertices: Array  # (v, 3) float32 m, of all static solids
    triangles: Array  # (t, 3) uint32, counter-clockwise seen from outside
    colors: Array  # (t, 3) uint8
    obstacles: tuple[Obstacle, ...] = ()
    targets: tuple[tuple[str, float, float], ...] = ()  # name, x m, y m, at the start
    shapes: Mapping[str, tuple[ShapePart, ...]] = {}  # of vehicles with shapes of their own, by name
    bounds: tuple[float, float, float, float] | None = None  # west, south, east, north, m
    floor: Floor | None = None
    live: bool = False  # a current run; else a recording
    may: tuple[str, ...] = ()  # allowed orders: names of the `Order` classes' tags
    keys: Mapping[str, float] = {}  # scenario keys that may change at run time, and their present values
    events_ns: tuple[int, ...] = ()  # of a recording: times of the lines of its log
    site: str = ""  # scenario of the radio's rays, JSON; empty: the radio has none


class LinkStatus(Value, frozen=True, kw_only=True):
    """The newest frame of a sender, with its outcome at each receiver."""

    sender: str
    sent_ns: int
    receivers: tuple[str, ...]
    rssi_dbm: Array  # (n,) float64
    received: Array  # (n,) bool
    outcome: tuple[str, ...]  # "received" or the cause of the loss

    @classmethod
    def of(cls, report: FrameReport) -> Self:
        """The part of a report that the page shows."""
        return cls(
            sender=report.sender,
            sent_ns=report.sent_ns,
            receivers=report.receivers,
            rssi_dbm=frozen(report.rssi_dbm, np.float64),
            received=frozen(report.received_ns >= 0, np.bool_),
            outcome=report.outcome,
        )


class Pace(Value, frozen=True, kw_only=True):
    """Pace of a run."""

    paused: bool = False
    speed: float | None = None  # target, simulated seconds per second; None: as fast as possible
    achieved: float | None = None  # over the last second
    waiting: str = ""  # what a run that has not begun waits for
    over: str = ""  # why the run has ended; empty: it continues


class PageUpdate(Value, frozen=True, kw_only=True):
    """State of a run at an instant. Mappings hold the newest value of each key; unchanged values may be omitted.

    An update with an earlier time than the previous one is complete: nothing is omitted.
    """

    time_ns: int
    states: States | None = None
    obstacles: Mapping[str, Pose] = {}
    targets: Mapping[str, tuple[float, float]] = {}
    places: Mapping[str, Follows] = {}  # slots of followers
    notes: Mapping[str, dict[str, float | str | bool]] = {}  # newest notes of each agent, by vehicle: "mode" is its commander
    fixes: Mapping[str, Fix] = {}
    scans: Mapping[str, Scan] = {}  # by vehicle/sensor
    images: Mapping[str, Image] = {}  # by vehicle/sensor
    sightings: Mapping[str, Sightings] = {}  # by vehicle
    maps: Mapping[str, ProbabilityMap] = {}
    mosaics: Mapping[str, Mosaic] = {}
    links: tuple[LinkStatus, ...] = ()  # of senders with a frame since the last update
    sent: Array | None = None  # (n, n) int64: frames from the row's vehicle for the column's, as in `Scenery`
    received: Array | None = None  # (n, n) int64: received ones among them
    heard_ns: Mapping[str, int] = {}  # time of each vehicle's last reception
    presence: Mapping[str, Presence] = {}  # of agents that were lost, or are back
    real: Mapping[str, RealStatus] = {}
    halted: tuple[str, ...] = ()  # vehicles stopped by the operator
    lines: tuple[LogLine, ...] = ()  # since the last update
    crafts: tuple[Craft, ...] = ()  # all vehicles again, once their agents are known; empty: as before
    pace: Pace = Pace()


class Sensors(Value, frozen=True, kw_only=True, tag_field="kind", tag="sensors"):
    """Show these readings and no others: each costs the run computing time."""

    names: tuple[str, ...]  # vehicle/sensor


class Go(Value, frozen=True, kw_only=True, tag_field="kind", tag="pace"):
    """Continue at this pace."""

    paused: bool = False
    speed: float | None = None  # None: as fast as possible
    step_ns: int = 0  # paused: run for this long, then pause again


class Seek(Value, frozen=True, kw_only=True, tag_field="kind", tag="seek"):
    """Show this instant of a recording."""

    time_ns: int


class End(Value, frozen=True, kw_only=True, tag_field="kind", tag="end"):
    """End the run, as Ctrl-C does."""


Order = Sensors | Go | Seek | End | InterventionTable
"""Order from the station; the time of an intervention is the instant of its execution."""
