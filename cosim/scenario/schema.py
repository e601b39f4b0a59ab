"""The tables of a scenario: one class per table, with all keys and defaults.

Tables with a kind (``physics``, ``world``, the layers of ``radio``, a vehicle, an agent, a driver) stay mappings: their keys
are the constructor parameters of the kind, checked when it is built (`cosim.assembly.run`).
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

from vcmvsp.cosim.types import Count, Decibels, Name, NonNegative, OnLost, Period, Positive, Seconds, Seed, Value, Vec3
from vcmvsp.cosim.vehicle_clock import VehicleClock

Duration = Annotated[float, msgspec.Meta(ge=1e-6, le=1e9)]  # s
Coordinate = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]  # m
Efficiency = Annotated[float, msgspec.Meta(gt=0, le=1)]
Runs = Literal["inprocess", "process", "zenoh"]
SIMULATED = "none"  # kind of an absent driver or localisation; without a driver, the vehicle is simulated
PoseSource = Literal["truth", "odometry", "positioning", "fusion"]


class AgentsTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[agents]``: where agents run and how fast; every other key is a default for agents that take such a parameter."""

    runs: Runs = "inprocess"  # inprocess | process (child processes) | zenoh (hosts that are started by hand)
    processes: Count | None = None  # with runs = "process": number of processes for the agents; default: one each
    listen: str = "tcp/127.0.0.1:7447"  # with runs = "zenoh": endpoint to which hosts connect
    deadline_s: Period = 2.0  # wall-clock time within which a remote agent must answer
    join_timeout_s: Period = 60.0  # wall-clock time within which all hosts must have joined
    period_s: Period | None = None  # s between ticks; default: the agent's own period
    latency_s: Seconds = 0.0  # s from an observation to the effect of the command
    on_lost: OnLost = "stop"  # reaction to a lost agent, host or robot: stop (the run) | hold (the last command) | remove
    hold_s: Seconds = 1.0  # with on_lost = "hold": time after which the vehicle stops
    defaults: Mapping[str, Any] = {}


class AgentTable(msgspec.Struct, frozen=True, kw_only=True):
    """A vehicle's ``agent``; every key not listed is a parameter of the agent, and wins over ``[agents]``."""

    kind: str | None = None  # short name | module:Class | file.py:Class; default: agents.kind
    runs: Runs | None = None  # default: agents.runs
    period_s: Period | None = None
    latency_s: Seconds | None = None
    fails_s: Seconds | None = None  # time at which it fails: from then on its vehicle stands still and sends nothing
    on_lost: OnLost | None = None  # default: agents.on_lost
    hold_s: Seconds | None = None  # s; default: agents.hold_s
    params: Mapping[str, Any] = {}


class BatteryTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A vehicle's ``battery``: its energy, and what takes it. At its end the agent fails, as at ``fails_s``."""

    capacity_wh: Positive  # energy of the full battery, W h
    charge: Annotated[float, msgspec.Meta(gt=0, le=1)] = 1.0  # at the start, as a share of the capacity
    electronics_w: NonNegative = 0.0  # constant power of computer, sensors and a waiting radio, W
    tx_w: NonNegative = 0.0  # additional power while its radio sends, W
    rx_w: NonNegative = 0.0  # additional power while it receives a frame that arrives, W
    mass_kg: Positive | None = None  # of the vehicle; default: that of the kind, if it has one
    rotor_radius_m: Positive | None = None  # of each of four rotors; default: the kind's, if it has one
    rotor_efficiency: Efficiency = 0.54  # ideal power by momentum theory over shaft power; 190 g from 16.8 W with 8 inches
    drive_efficiency: Efficiency = 0.75  # shaft or wheel power over power from the battery; assumed
    rolling_resistance: NonNegative = 0.02  # force over weight, on wheels; rubber on a hard floor, assumed
    period_s: Period = 1.0  # s between readings


class VehicleTable(msgspec.Struct, frozen=True, kw_only=True):
    """A ``[[vehicle]]``; every key not listed is a parameter of its kind. ``[vehicles]`` holds defaults for all of them."""

    name: Name
    kind: str
    pose: tuple[float, float, float] | None = None  # x m, y m, yaw rad; or, in its place:
    position: Vec3 = (0.0, 0.0, 0.0)  # x, y, z m
    heading: float = 0.0  # rad, counter-clockwise from east
    pose_source: PoseSource = "truth"  # what its agent takes for its own pose
    positioning: Mapping[str, Any] | None = None  # the positioning sensor, if it carries one
    driver: Mapping[str, Any] | None = None  # of the real vehicle in the place of the simulated one: a table with a kind
    firmware: Mapping[str, Any] | None = None  # of a simulated quadrotor, in place of its own autopilot: a table with a kind
    localisation: Mapping[str, Any] | None = None  # what tells where the real one is: a table with a kind; None: its odometry
    fusion: Mapping[str, Any] = {}  # how both become a pose
    safety: Mapping[str, Any] = {}  # keys of [safety] that are this vehicle's own
    sensors: Mapping[str, Mapping[str, Any]] = {}  # what else it carries, by names of one's own: a table with a kind each
    radio: Mapping[str, Any] = {}  # what its own radio has: tx_power_dbm, antenna_gain_dbi, ...
    radios: tuple[Name, ...] | None = None  # names of those of several radios that it has; None: all
    battery: BatteryTable | None = None  # its energy; default: it never ends
    clock: VehicleClock | None = None  # its own clock; default: the time of the run
    agent: AgentTable | None = None  # None: it has no agent and stands still
    params: Mapping[str, Any] = {}

    def __post_init__(self) -> None:
        if self.pose is not None and (any(self.position) or self.heading):
            raise ValueError("use either pose, or position and heading, not both")

    @property
    def is_real(self) -> bool:
        """Whether a real vehicle replaces the simulated one."""
        return self.driver is not None and self.driver.get("kind") != SIMULATED

    @property
    def start(self) -> tuple[Vec3, float]:
        """Start pose: position m, heading rad."""
        if self.pose is None:
            return self.position, self.heading
        x, y, yaw = self.pose
        return (x, y, 0.0), yaw


class StationTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``[[station]]``: a fixed place without a body, else like a vehicle of kind ``station``; [vehicles] has no effect."""

    name: Name
    position: Vec3 = (0.0, 0.0, 0.0)  # x, y, z m
    sensors: Mapping[str, Mapping[str, Any]] = {}  # what it carries, by names of one's own: a table with a kind each
    radio: Mapping[str, Any] = {}  # what its own radio has: tx_power_dbm, antenna_gain_dbi, ...
    radios: tuple[Name, ...] | None = None  # names of those of several radios that it has; None: all
    battery: BatteryTable | None = None  # its energy; default: it never ends
    clock: VehicleClock | None = None  # its own clock; default: the time of the run
    agent: AgentTable | None = None  # None: it has no agent


class SafetyTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[safety]``: limits that every real vehicle keeps, whatever its commands."""

    max_speed: Positive | None = None  # m/s; default: the kind's, and at most 1
    max_yaw_rate: Positive | None = None  # rad/s; default: the kind's, and at most 2
    accel: Positive | None = None  # m/s2; default: the kind's, else 0.3
    decel: Positive | None = None  # m/s2, deceleration guaranteed when braking; default: the kind's, else 0.3
    yaw_accel: Positive | None = None  # rad/s2, also of slowing down; default: the kind's, else 1.5
    max_climb: Positive = 1.0  # m/s, up and down, of flying vehicles
    radius_m: Positive | None = None  # of a circle around the body; default: around its hull
    fence: tuple[tuple[float, float], ...] | None = None  # corners (x, y) of the allowed area, m; default: no fence
    fence_margin_m: NonNegative = 0.1  # between body and fence: for the error of the pose
    floor_m: float | None = None  # minimum height of flying vehicles
    ceiling_m: float | None = None  # maximum height of flying vehicles
    separation_m: NonNegative = 0.3  # between bodies
    jump_m: Positive = 1.0  # a position jump beyond this, against odometry, stops the vehicle until the run ends
    reaction_s: Positive = 0.25  # time from a command to the effect of the next one, including delays of pose and link
    operator_s: Positive | None = None  # longest silence of `vcmvsp operator`; default: not required
    command_s: Positive | None = None  # longest time without a command; default: 0.5, or 2.5 periods of its agent
    positioning_s: Positive = 1.5  # longest time without a position
    federation_s: Positive = 0.5  # longest silence of the run


class ClockTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[clock]``: synchronisation with the wall clock, with real vehicles or ``--realtime``."""

    late: Literal["slip", "stop"] = "slip"  # effect of a late instant: "slip" delays all later ones; "stop" ends the run
    tolerance_s: Positive | None = None  # lateness that counts as late; default: one period of the quickest agent


class BridgeTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[bridge]``: programs as they are, at wall pace; every other key is a table ``[bridge.KIND]``, a door for them."""

    agents: bool = False  # agents hear the bytes that programs send, and programs what agents send (MessagePack)
    doors: Mapping[str, Any] = {}


class SocketsTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[sockets]``: programs that keep the run's own time (`cosim.sockets`); the run waits for them, they for it."""

    vehicles: tuple[Name, ...] = ()  # whose programs take part; each has one
    listen: str = "tcp/127.0.0.1:7550"  # tcp/HOST:PORT or unix/PATH
    join_timeout_s: Period = 60.0  # wall-clock time within which all must have come
    deadline_s: Period | None = None  # wall-clock time within which a program must go on; default: it may take its time


class RecordTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[record]``."""

    period_s: Period = 0.1  # s between recorded states
    sensors: tuple[str, ...] = ()  # names of scanners and cameras whose readings are recorded; "*": all. Others always are
    heard: bool = False  # the messages that each agent gets at each tick; ``radio/frame`` has every reception anyway
    least_rssi_dbm: Decibels | None = None  # frames are recorded without receivers below it that lost them; default: with all
    video: bool = False  # a film of a mission, mission.mp4: some seconds of work after the run


class MetricsTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[metrics]``: the window of the formation error and the age of information, and metrics of your own."""

    from_s: NonNegative = 0.0
    to_s: NonNegative | None = None  # default: the end
    own: Mapping[Name, Mapping[str, Any]] = {}  # a table per metric, which is `own.NAME` in metrics.json and studies


class OutageTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="outage"):
    """An ``[[intervention]]``: all frames from and to some vehicles are lost for some time."""

    at_s: Seconds  # when
    for_s: Duration  # for how long
    vehicles: tuple[str, ...] = ()  # whose; none named: all


class HaltTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="halt"):
    """An ``[[intervention]]``: halt vehicles, whatever their agents command, or release them."""

    at_s: Seconds  # when
    vehicles: tuple[str, ...] = ()  # which; none named: all
    halted: bool = True  # false: let them go on


class MoveTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="move"):
    """An ``[[intervention]]``: an obstacle that can be pushed is put somewhere else, and rests there."""

    at_s: Seconds  # when
    obstacle: str  # its name in the world
    position: tuple[Coordinate, Coordinate]  # x, y m
    yaw: Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)] = 0.0  # rad


class SetTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="set"):
    """An ``[[intervention]]``: a number of the layers of loss and delay has another value from then on."""

    at_s: Seconds  # when
    key: str  # radio.loss.* or radio.delay.*
    value: float


InterventionTable = OutageTable | HaltTable | MoveTable | SetTable
"""An intervention of an operator; the control station adds its own to the scenario, so that a run can be repeated."""


class StudyTable(msgspec.Struct, frozen=True, kw_only=True):
    """``[study]``: defaults of ``vcmvsp study`` for this scenario."""

    vary: Mapping[str, tuple[Any, ...]] = {}  # key path -> its values
    seeds: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 20  # runs of each combination of values
    metrics: tuple[str, ...] = ()  # what is drawn and summarised, e.g. "formation.rms_m"


class Scenario(msgspec.Struct, frozen=True, kw_only=True):
    """A whole scenario. ``duration_s`` is simulated time; agents act at 0 <= t < duration."""

    name: Name
    duration_s: Duration
    seed: Seed = 0
    physics: Mapping[str, Any] = {}  # kind = "bullet" | "kinematic" | "mujoco" | "flight"
    world: Mapping[str, Any] = {}  # kind = "empty" | "boxes"
    radio: Mapping[str, Any] | tuple[Mapping[str, Any], ...] = {}  # preset = "ideal" | "wss" | "wifi-b-1" | ..., and its layers
    routing: Mapping[str, Any] = {}  # kind = "none" | "flooding" | "static" | "distance_vector"
    bridge: BridgeTable = BridgeTable()
    sockets: SocketsTable = SocketsTable()
    stack: Mapping[str, Any] = {}  # a table [stack.KIND] per kind of programs that drive vehicles: ros2 | crazyflie
    agents: AgentsTable = AgentsTable()
    clock: ClockTable = ClockTable()
    safety: SafetyTable = SafetyTable()
    vehicles: Mapping[str, Any] = {}
    record: RecordTable = RecordTable()
    metrics: MetricsTable = MetricsTable()
    study: StudyTable = StudyTable()
    intervention: tuple[InterventionTable, ...] = ()
    vehicle: tuple[VehicleTable, ...]  # the stations are the last ones
    station: tuple[StationTable, ...] = ()

    @property
    def radios(self) -> dict[str, Mapping[str, Any]]:
        """Tables of several radios, by name; empty: there is one without a name."""
        several = () if isinstance(self.radio, Mapping) else self.radio
        return {each["name"]: each for each in several}

    @property
    def first_radio(self) -> Mapping[str, Any]:
        """The table of the only radio, or of the first of several."""
        return self.radio if isinstance(self.radio, Mapping) else self.radio[0]

    @property
    def radio_members(self) -> dict[str, tuple[str, ...]]:
        """Vehicles with each of several radios, by its name."""
        members = {}
        for radio in self.radios:
            members[radio] = tuple([each.name for each in self.vehicle if each.radios is None or radio in each.radios])
        return members

    def with_radio(self, name: str) -> "Scenario":
        """The scenario with one of several radios as its only one, also in the tables ``radio`` of its vehicles."""
        table = {key: value for key, value in self.radios[name].items() if key not in ("name", "channel")}
        vehicles = []
        for each in self.vehicle:
            common = {key: value for key, value in each.radio.items() if key not in self.radios}
            vehicles.append(msgspec.structs.replace(each, radio={**common, **each.radio.get(name, {})}))
        return msgspec.structs.replace(self, radio=table, vehicle=tuple(vehicles))

    @property
    def real(self) -> tuple[str, ...]:
        """Names of the real vehicles."""
        return tuple(each.name for each in self.vehicle if each.is_real)

    @property
    def twins(self) -> dict[str, str]:
        """Settings that make all real vehicles simulated."""
        return {f"vehicle.{name}.driver.kind": SIMULATED for name in self.real}


class RealVehicle(Value, frozen=True, kw_only=True):
    """Specification of a real vehicle from the scenario."""

    name: str
    kind: str  # of its simulated twin, as written
    folder: str  # of the scenario
    driver: str  # its kind, as written
    driver_params: dict[str, Any]
    localisation: str | None  # its kind, as written
    localisation_params: dict[str, Any]
    fusion: dict[str, Any]
    safety: SafetyTable  # complete: defaults filled in
    pose_source: str
    start: Vec3  # x m, y m, yaw rad
    height_m: float  # of its reference point above the ground
    flies: bool
    positioning: dict[str, Any] | None  # of its simulated twin, complete
    seed: int
    on_lost: OnLost = "stop"  # when its robot is lost: that of its agent
