"""Messages between a run, or a recording, and the control station.

`Scenery` is sent once and holds what does not change; `PageUpdate` follows at most thirty times a second; `Order` is the answer
of the station with the user's input. A recording uses the same three messages.
"""

from collections.abc import Mapping
from typing import Literal

from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.scenario.schema import InterventionTable
from vcmvsp.cosim.types import (
    Array,
    Fix,
    Follows,
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
)

Pose = tuple[float, float, float, float]
"""x, y, z m and yaw rad, world."""


class Craft(Value, frozen=True, kw_only=True):
    """A vehicle."""

    name: str
    kind: str  # as the scenario has it
    size: Vec3  # of its body, m: along, across, up
    offset: Vec3 = (0.0, 0.0, 0.0)  # of the middle of its body from its reference point, m, in its own frame
    flies: bool = False
    real: bool = False
    agent: str = ""  # kind of its agent; empty: it has none
    period_s: float | None = None  # between its agent's ticks
    sensors: Mapping[str, str] = {}  # name -> kind: what can be asked for with `Order.sensors`


class Obstacle(Value, frozen=True, kw_only=True):
    """A solid that can be moved about, or moves by itself."""

    name: str
    shape: Literal["box", "cylinder"]
    size: Vec3  # m; of a cylinder: its diameter twice, and its height
    pose: Pose  # of its centre, at the start
    color: tuple[int, int, int]
    may_be_moved: bool = False  # by the one who looks


class Scenery(Value, frozen=True, kw_only=True):
    """What does not change during a run."""

    scenario: str
    seed: int
    duration_ns: int
    vehicles: tuple[Craft, ...]
    vertices: Array  # (v, 3) float32 m, of all that stands still
    triangles: Array  # (t, 3) uint32, counter-clockwise seen from outside
    colors: Array  # (t, 3) uint8
    obstacles: tuple[Obstacle, ...] = ()
    targets: tuple[tuple[str, float, float], ...] = ()  # name, x m, y m, at the start
    bounds: tuple[float, float, float, float] | None = None  # west, south, east, north, m
    live: bool = False  # a run that goes on; else the recording of one
    may: tuple[str, ...] = ()  # which orders are obeyed: names of the `Order` classes' tags
    keys: Mapping[str, float] = {}  # keys of the scenario that may be changed at run time, and their present values


class LinkStatus(Value, frozen=True, kw_only=True):
    """The newest frame of a sender: what became of it at each receiver."""

    sender: str
    sent_ns: int
    receivers: tuple[str, ...]
    rssi_dbm: Array  # (n,) float64
    received: Array  # (n,) bool
    outcome: tuple[str, ...]  # "received" or the cause of the loss


class Pace(Value, frozen=True, kw_only=True):
    """How a run goes on."""

    paused: bool = False
    speed: float | None = None  # simulated seconds per second that are wanted; None: as fast as it can
    achieved: float | None = None  # over the last second
    over: str = ""  # why the run has ended; empty: it goes on


class PageUpdate(Value, frozen=True, kw_only=True):
    """How things stand at an instant. Mappings hold the newest of each key so far; what has not changed may be left out.

    One that is earlier than the one before it begins anew: nothing is left out.
    """

    time_ns: int
    states: States | None = None
    obstacles: Mapping[str, Pose] = {}
    targets: Mapping[str, tuple[float, float]] = {}
    places: Mapping[str, Follows] = {}  # who means to keep which place
    notes: Mapping[str, dict[str, float | str | bool]] = {}  # what each agent noted last, by vehicle: "mode" says who commands
    fixes: Mapping[str, Fix] = {}
    scans: Mapping[str, Scan] = {}  # by vehicle/sensor
    images: Mapping[str, Image] = {}  # likewise
    sightings: Mapping[str, Sightings] = {}  # by vehicle
    maps: Mapping[str, ProbabilityMap] = {}
    mosaics: Mapping[str, Mosaic] = {}
    links: tuple[LinkStatus, ...] = ()  # of senders with a frame since the last time
    sent: Array | None = None  # (n, n) int64: frames of the row's vehicle for the column's, as in `Scenery`
    received: Array | None = None  # (n, n) int64: of those
    heard_ns: Mapping[str, int] = {}  # when each vehicle received last
    presence: Mapping[str, Presence] = {}  # of agents that were lost, or are back
    real: Mapping[str, RealStatus] = {}
    halted: tuple[str, ...] = ()  # vehicles that the operator has stopped
    lines: tuple[LogLine, ...] = ()  # since the last time
    pace: Pace = Pace()


class Sensors(Value, frozen=True, kw_only=True, tag_field="kind", tag="sensors"):
    """Show these readings, and no others: they cost the run time."""

    names: tuple[str, ...]  # vehicle/sensor


class Go(Value, frozen=True, kw_only=True, tag_field="kind", tag="pace"):
    """Go on at this pace."""

    paused: bool = False
    speed: float | None = None  # None: as fast as it can
    step_ns: int = 0  # paused: go on for so long, then stand again


class Seek(Value, frozen=True, kw_only=True, tag_field="kind", tag="seek"):
    """Show this instant of a recording."""

    time_ns: int


class End(Value, frozen=True, kw_only=True, tag_field="kind", tag="end"):
    """End the run, as Ctrl-C does."""


Order = Sensors | Go | Seek | End | InterventionTable
"""What the station asks for; the time of an intervention is that of the instant at which it is done."""
