"""Protocol of a physics engine, commands to it, contacts from it.

Vehicles are rows of arrays; there is no object per vehicle. An engine is constructed with the world, the models
(`physics.vehicles.models`), start positions and headings, and its step rate if it has one. Another engine (e.g. MuJoCo) needs

* bodies from the models' parameters, from ``World.mesh()``, movables and the time-tables of moving obstacles;
* ground robots: one call of `physics.dynamics.kinematic.Firmware` a step, which returns the wheel speeds to hold;
* quadrotors: force and torque of `physics.dynamics.quadrotor_fleet.QuadrotorFleet`, with arrays that the engine updates;
* the same bits from the same calls, independent of the order of a set, of other engines, and of the number of reads.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event, FlightFirmware, vehicle_of
from vcmvsp.cosim.types import Array, Contact, Vec3, Velocity, Waypoint
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.world.world import Moving


class BodyMotion(NamedTuple):
    """Motion of n bodies at one instant; the arrays never change."""

    position: Array  # (n, 3) m, world, of the reference points
    velocity: Array  # (n, 3) m/s, world
    attitude: Array  # (n, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (n, 3) rad/s, body
    acceleration: Array  # (n, 3) m/s2, world, mean over the engine's last step
    wheels: Array  # (n, 2) rad, turns of the left and right wheel; NaN without wheels
    odometry: Array  # (n, 5) x m, y m, yaw rad, v m/s, w rad/s, of the wheels; NaN without wheels


class Touch(NamedTuple):
    """Contact of two bodies, or of a body and a solid, with a force. The floor does not count."""

    row: int  # a vehicle
    other: int | None  # another vehicle, of a greater row; n + k: the k-th movable, then the k-th obstacle; None: a solid
    place: Vec3  # m, world

    @property
    def key(self) -> tuple[int, int]:
        """Sort key."""
        return self.row, -1 if self.other is None else self.other


class Engine:
    """Moves vehicles and the movables that they push. The base class has no bodies: no collisions, no pushed movables."""

    stepped = False  # whether it has steps of its own: many short advances give the same bits as one long one

    def expect(self, duration_ns: int, *, now: bool) -> None:
        """Hint of the simulated time to come, ns; ``now``: what takes time must not be put off, since the run is paced."""

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, in the body frame on the ground and the world frame in the air, and a yaw rate, rad/s."""
        raise NotImplementedError

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly to a position, m, and hover there with ``yaw``, rad, at ``speed``, m/s, at most; never on the ground.

        ``yaw`` None: the present heading. ``speed`` None: the vehicle's greatest.
        """
        raise NotImplementedError

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``; by default nothing moves."""

    def read(self) -> BodyMotion:
        """Motion of every vehicle. Reading changes nothing."""
        raise NotImplementedError

    def movables(self) -> BodyMotion:
        """Motion of every movable; no rows if the engine cannot push them."""
        return NO_BODIES

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable at rest, its centre at ``place``, m, upright, turned by ``yaw`` rad."""

    def touching(self, *, passing: bool) -> list[Touch]:
        """Present contacts by rows; with ``passing`` also contacts that ended since the last call with ``passing``."""
        return []

    def close(self) -> None:
        """Release all resources; a second call has no effect."""


class FleetEngine(Engine):
    """An engine with quadrotors in a fleet, and with steps of its own: ``advance`` goes to the nearest one."""

    stepped = True
    fleet: QuadrotorFleet  # in the order of their vehicles
    _flyer_of: Mapping[int, int] | Sequence[int]  # rows of the fleet by rows of the engine

    def __init__(self, rate_hz: float) -> None:
        self._ticks, self._step, self._step_s = Ticks.rate(rate_hz), 0, 1.0 / rate_hz

    def expect(self, duration_ns: int, *, now: bool) -> None:
        """Compile the laws of quadrotors, if that pays or has to be done now."""
        self.fleet.expect(duration_ns / SECOND_NS / self._step_s, now=now)

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly to a position, m, and hover there."""
        self.fleet.set_waypoint(self._flyer_of[row], position, yaw, speed)

    def _step_at(self, time_ns: int) -> int:
        """Number of the step nearest to a time."""
        return (time_ns * self._ticks.per + self._ticks.ns // 2) // self._ticks.ns


def side_by_side(*columns: Array) -> Array:
    """Columns (n,) as one array (n, k); `numpy.column_stack` takes three times as long."""
    return np.array(columns).T.copy()


def without_wheels(position: Array, velocity: Array, attitude: Array, spin: Array, acceleration: Array) -> BodyMotion:
    """Motion of bodies without wheels; arrays and units as in `BodyMotion`."""
    n = len(position)
    return BodyMotion(position, velocity, attitude, spin, acceleration, np.full((n, 2), np.nan), np.full((n, 5), np.nan))


def flown(fleet: QuadrotorFleet, step_s: float) -> BodyMotion:
    """Motion of quadrotors after a step of ``step_s``."""
    acceleration = (fleet.velocity - fleet.velocity_before) / step_s
    state = fleet.position, fleet.velocity, fleet.attitude, fleet.rate, acceleration
    return without_wheels(*(each.copy() for each in state))


def still(position: Array, heading: Array) -> BodyMotion:
    """Bodies at rest: positions (n, 3) m, headings (n,) rad."""
    attitude = np.zeros((len(position), 4))
    attitude[:, 0], attitude[:, 3] = np.cos(0.5 * heading), np.sin(0.5 * heading)
    zero = np.zeros((len(position), 3))
    return without_wheels(position, zero, attitude, zero, zero)


NO_BODIES = still(np.empty((0, 3)), np.empty(0))


def gathered(parts: "list[tuple[BodyMotion, Array]]", count: int) -> BodyMotion:
    """Motion of ``count`` vehicles from several engines, each with the rows (k,) of its vehicles; read-only."""
    if len(parts) == 1 and len(parts[0][1]) == count:
        whole = parts[0][0]  # one engine has all rows, in order
    else:
        whole = BodyMotion(*(np.full((count, width), np.nan) for width in (3, 3, 4, 3, 3, 2, 5)))
        for motion, rows in parts:
            for target, source in zip(whole, motion, strict=True):
                target[rows] = source
    for array in whole:
        array.setflags(write=False)
    return whole


class Contacts:
    """Contacts of all engines, each with the rows (k,) of its vehicles; ``names``: of vehicles first, then of other bodies."""

    def __init__(self, engines: Sequence[tuple[Engine, Array]], vehicles: int, names: tuple[str, ...]) -> None:
        self._names, others = names, range(vehicles, len(names))
        self._engines = [(each, [*rows.tolist(), *others]) for each, rows in engines]
        self._touching: frozenset[tuple[int, int | None]] = frozenset()

    def now(self, *, passing: bool) -> list[Touch]:
        """Present contacts; ``passing`` as in `Engine.touching`."""
        touches = []
        for engine, rows in self._engines:
            for row, other, place in engine.touching(passing=passing):
                touches.append(Touch(rows[row], None if other is None else rows[other], place))
        return touches

    def begun(self, now_ns: int) -> list[Event]:
        """Contacts that began since the last call, also short ones that have ended."""
        pairs = dict.fromkeys((each.row, each.other) for each in self.now(passing=True))
        before, self._touching = self._touching, frozenset(pairs)
        events = []
        for row, other in (pair for pair in pairs if pair not in before):
            contact = Contact(vehicle=self._names[row], other=None if other is None else self._names[other])
            events.append(Event("world/contact", now_ns, contact))
        return events


Command = Velocity | Waypoint
_STILL = Velocity()  # ground: the wheels stand; air: it hovers


class Mover(NamedTuple):
    """Engine of one vehicle, its row there, and whether it flies."""

    engine: Engine
    row: int
    flies: bool

    def obey(self, command: Command) -> None:
        """Follow a command from now on."""
        if isinstance(command, Velocity):
            self.engine.command(self.row, command.linear, command.yaw_rate)
        else:
            self.engine.go_to(self.row, command.position, command.yaw, command.speed)


class FirmwareMover(NamedTuple):
    """Hands commands of one vehicle to its firmware."""

    firmware: FlightFirmware
    vehicle: str
    flies: bool = True

    def obey(self, command: Command) -> None:
        """Pass a command on."""
        self.firmware.command(self.vehicle, command)


class Commands:
    """Hands each simulated vehicle's newest command to its engine; ``advance`` advances all engines to a time, ns."""

    def __init__(self, movers: Mapping[str, Mover | FirmwareMover], advance: Callable[[int], None]) -> None:
        self._advance = advance
        self._movers = {f"{vehicle}/command": mover for vehicle, mover in movers.items()}
        self._newest: dict[str, Command] = {}
        self._halted: set[str] = set()
        self._advanced_ns = 0  # lower bound

    def take(self, key: str, time_ns: int, command: Command) -> None:
        """Apply a command with the key ``<vehicle>/command`` from ``time_ns`` on; commands of other vehicles are ignored.

        Of a `Velocity`, ground vehicles use forward speed and yaw rate.

        Raises:
            FederateError: it is not finite, or a `Waypoint` for a ground vehicle or with a speed that is not positive.
        """
        mover = self._movers.get(key)
        if mover is None:
            return
        _check_command(key, command, mover.flies)
        self._newest[key] = command
        if key in self._halted:
            return
        if time_ns > self._advanced_ns:  # most commands come together
            self._advance(time_ns)
            self._advanced_ns = time_ns
        mover.obey(command)

    def halt(self, vehicles: Sequence[str], time_ns: int, *, halted: bool) -> None:
        """Halt vehicles from a time on, ns, or let them follow their newest commands again."""
        self._advance(time_ns)
        for key in (f"{vehicle}/command" for vehicle in vehicles):
            if key not in self._movers or (key in self._halted) == halted:
                continue
            (self._halted.add if halted else self._halted.discard)(key)
            self._movers[key].obey(_STILL if halted else self._newest.get(key, _STILL))


def _check_command(key: str, command: Command, flying: bool) -> None:
    if isinstance(command, Velocity):
        x, y, z = command.linear
        if isfinite(x + y + z + command.yaw_rate):
            return  # a sum is finite only if all are
        numbers = [x, y, z, command.yaw_rate] if flying else [x, command.yaw_rate]
    else:
        numbers = [*command.position, command.yaw or 0.0, command.speed or 0.0]
    vehicle, problem = vehicle_of(key), ""
    if isinstance(command, Waypoint) and not flying:
        problem = f"{vehicle} received a Waypoint but cannot fly: send Velocity, or use a quadrotor or a point"
    elif not all(map(isfinite, numbers)):
        problem = f"the command of {vehicle} is not finite: {command}"
    elif isinstance(command, Waypoint) and command.speed is not None and command.speed <= 0.0:
        problem = f"the speed of the Waypoint of {vehicle} must be positive, not {command.speed} m/s"
    if problem:
        raise FederateError("physics", problem)


def on_time(moving: Sequence[Moving], now_ns: int) -> BodyMotion:
    """Moving obstacles at a time, by their time-tables."""
    now_s = now_ns / SECOND_NS
    places = np.array([each.pose(now_s) for each in moving], float).reshape(-1, 4)
    speeds = np.array([each.rates(now_s) for each in moving], float).reshape(-1, 4)
    turning = np.zeros((len(moving), 3))
    turning[:, 2] = speeds[:, 3]
    return still(places[:, :3], places[:, 3])._replace(velocity=speeds[:, :3], angular_velocity=turning)
