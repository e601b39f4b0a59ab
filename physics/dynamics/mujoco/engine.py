"""The MuJoCo engine: ground robots, quadrotors, external vehicles and movables in one MuJoCo world, and their contacts.

A wheel's motor holds a speed with a torque of its own at most. An actuator with a high gain is the wrong means: its implicit
integration comes after the contact forces and disturbs them, so that robots shake. Here the motor is the friction of the
wheel's joint, which MuJoCo solves together with the contacts: a constraint towards speed 0, whose reference is moved to the
commanded speed in the middle of each step.

Quadrotors fly by `physics.dynamics.quadrotor_fleet`, like those in Bullet; the effect of a contact comes from MuJoCo.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.engine import NO_BODIES, BodyMotion, FleetEngine, Touch, flown, gathered, on_time, without_wheels
from vcmvsp.physics.dynamics.external_path import ExternalPath
from vcmvsp.physics.dynamics.kinematic import ExternalEngine, Firmware
from vcmvsp.physics.dynamics.mujoco.bodies import MOTOR_IMPEDANCE, MOTOR_STEPS, Builder, set_inertia
from vcmvsp.physics.dynamics.odometry import ENCODER_HZ, DifferentialOdometry
from vcmvsp.physics.dynamics.quadrotor_fleet import fleet_of
from vcmvsp.physics.dynamics.wind import Gusts
from vcmvsp.physics.vehicles.specification import VehicleSpec, roles_of
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.solids import heading_of
from vcmvsp.physics.world.world import World, rotations

_FRICTION = 0.5  # of hulls, assumed
_FLOOR_GEOM, _FLOOR, _SOLID = 0, -2, -1
_RESTS = 1e-3  # m/s, rad/s: a slower movable rests
_TREMBLES = 1e-4  # m: a movable that has crept so far is reported anew
_SETTLING = 60  # steps
_SLIDING, _TANGENTS = 3, np.array([1, 2])  # rows of a contact: normal, and two of friction
_SLIP = 0.05  # m/s: faster sliding is slowed down no more than this


class MujocoEngine(FleetEngine):
    """Moves differential drives and quadrotors in one MuJoCo world; arguments as for `BulletEngine`, without iterations."""

    def __init__(
        self,
        *,
        world: World,
        vehicles: Sequence[VehicleSpec],
        seed: int = 0,
        rate_hz: float,
        gravity: float,
        accelerations: bool = False,
        external: ExternalEngine | None = None,
    ) -> None:
        super().__init__(rate_hz)
        self._accelerations, self._world, self._count = accelerations, world, len(vehicles)
        self._encoder_steps = max(1, round(rate_hz / ENCODER_HZ))
        ground, air, outside = roles_of(vehicles, external.names if external else ())
        self._external_rows = [*outside]
        builder = Builder(world, self._step_s, gravity)
        for row, spec in ground.items():
            model: Any = spec.model
            builder.add_drive(f"{row}", model, spec.start, spec.heading)
        for row, spec in air.items():
            _add_quadrotor(builder, f"{row}", spec)
        for row, spec in outside.items():
            builder.add_heavy(f"{row}", spec.model.hull, spec.start, spec.heading, _FRICTION)
        bodies = range(len(vehicles), len(vehicles) + len(world.movables) + len(world.moving))
        self._movables, self._moving = bodies[: len(world.movables)], bodies[len(world.movables) :]
        for number, movable in zip(self._movables, world.movables, strict=True):
            solid = movable.solid
            builder.add_body(f"{number}", solid.hull, movable.mass_kg, solid.center, heading_of(solid), movable.friction)
        for number, moving in zip(self._moving, world.moving, strict=True):
            x, y, z, yaw = moving.pose(0.0)
            builder.add_heavy(f"{number}", moving.solid.hull, (x, y, z), yaw, _FRICTION)
        self._model, self._data = _compiled(builder.spec)
        self._rate = 1.0 / (MOTOR_STEPS * self._step_s)  # 1/s
        self._row_of_geom = self._rows_of_geoms()
        self._robots = _Robots(self._model, self._data, ground, world)
        gusts = Gusts(world.wind, [each.name for each in air.values()], seed)
        self._flyers = _Flyers(self._model, self._data, air, gravity, gusts)
        self.fleet, self._flyer_of = self._flyers.fleet, self._flyers.place_of
        self._external, self._path = external, ExternalPath(external, self._step_s) if external else None
        self._on_path = _Free(self._model, self._data, [*self._external_rows, *self._moving])
        self._pushed = _Movables(self._model, self._data, self._movables)
        self._passing: list[Touch] = []  # begun since the last call of `touching` with ``passing``
        if ground:
            self._settle()
        self._touching, _ = self._touches()  # in the last step

    def _settle(self) -> None:
        """Let the floor bear the robots before the run, where they stand; nothing else moves."""
        data, robots = self._data, self._robots
        at, still = data.qpos.copy(), data.qvel.copy()
        start = robots.bodies.read()[0][:, 2]
        for _ in range(_SETTLING):
            self._advance_bodies()
        robots.sunk = robots.bodies.read()[0][:, 2] - start
        data.qpos[:], data.qvel[:], data.time = at, still, 0.0
        position, *rest = robots.bodies.read()
        position[:, 2] += robots.sunk
        robots.bodies.write(position, *rest)
        mj.mj_forward(self._model, data)

    def _advance_bodies(self) -> None:
        """One step of MuJoCo."""
        mj.mj_step1(self._model, self._data)
        self._robots.drive()
        self._limit_slip()
        mj.mj_step2(self._model, self._data)

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, and a yaw rate, rad/s, which firmware or autopilot approach."""
        if row in self._robots.place_of:
            self._robots.firmware.command(self._robots.place_of[row], linear[0], yaw_rate)
        else:
            self.fleet.set_velocity(self._flyer_of[row], linear, yaw_rate)

    def advance(self, to_ns: int) -> None:
        """Advance to the step nearest to ``to_ns``."""
        robots, flyers, until = self._robots, self._flyers, self._step_at(to_ns)
        while self._step < until:
            now_ns = self._ticks.at(self._step)
            robots.cycle(self._step_s)
            if self._accelerations and self._step + 1 == until:
                robots.save_velocities()
            self._place(now_ns)
            flyers.push(now_ns, self._step_s)
            self._advance_bodies()
            self._step += 1
            self._note_touches()
            if self._step % self._encoder_steps == 0:
                robots.encode()
                self._pushed.look()
        if any(each.number for each in self._data.warning):
            problem = f"MuJoCo became unstable before {to_ns / SECOND_NS:.3f} s: a higher physics.rate_hz helps"
            raise FederateError("physics", problem)
        if self._external:
            self._external.advance(to_ns)

    def _limit_slip(self) -> None:
        """Limit the reference of friction, after the first half of a step.

        MuJoCo's contacts are a convex problem: a shape that slides is lifted in proportion to friction and speed, and bounces.
        With a limited reference the direction of friction stays, and it still reaches its greatest force.
        """
        contact = self._data.contact
        if not len(contact.dist):
            return
        first = contact.efc_address
        counts = (first >= 0) & (contact.dim == _SLIDING)
        rows = (first[counts][:, None] + _TANGENTS).ravel()
        slips = self._data.efc_aref[rows].reshape(-1, 2)
        lags = contact.solref[counts, :1]  # s
        speeds = np.sqrt((slips * slips).sum(axis=1, keepdims=True)) * (0.5 * lags)  # m/s
        self._data.efc_aref[rows] = (slips * (lags * self._rate / np.maximum(speeds / _SLIP, 1.0))).ravel()

    def _note_touches(self) -> None:
        """After a step: quadrotors in contact take the states of their bodies; note contacts that have begun."""
        before = {(each.row, each.other) for each in self._touching}
        self._touching, on_floor = self._touches()
        self._flyers.take({row for each in self._touching for row in (each.row, each.other)} | on_floor)
        self._passing += [each for each in self._touching if (each.row, each.other) not in before]

    def _place(self, now_ns: int) -> None:
        """Put the bodies on paths in place with their velocities."""
        if not self._on_path.bodies:
            return
        parts = [on_time(self._world.moving, now_ns)]
        if self._path:
            parts.insert(0, self._path.step(now_ns))
        columns = zip(*(each[:4] for each in parts), strict=True)
        position, velocity, attitude, spin = map(np.concatenate, columns)
        self._on_path.write(position, velocity, attitude, np.einsum("nji,nj->ni", rotations(attitude), spin))

    def read(self) -> BodyMotion:
        """Motion of every vehicle."""
        parts = [(each.read(), np.array([*each.place_of])) for each in (self._robots, self._flyers) if each.place_of]
        if self._external:
            parts.append((self._external.read(), np.array(self._external_rows)))
        return gathered(parts, self._count)

    def movables(self) -> BodyMotion:
        """Motion of every movable."""
        if not self._movables:
            return NO_BODIES
        return without_wheels(*self._pushed.read(), np.zeros((len(self._movables), 3)))

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable at a place."""
        self._pushed.put(number, place, quaternion_from_yaw(yaw))

    def touching(self, *, passing: bool) -> list[Touch]:
        """Contacts in this step; with ``passing`` also those that began since the last such call."""
        touches = self._touching
        if passing:
            touches, self._passing = sorted(touches + self._passing, key=lambda each: each.key), []
        return touches

    def _touches(self) -> tuple[list[Touch], set[int]]:
        """Contacts of vehicles with a force in the last step, by rows: one for each place; rows of bodies on the floor."""
        contact = self._data.contact
        if not len(contact.dist):
            return [], set()
        rows = np.sort(self._row_of_geom[contact.geom], axis=1)
        pressed = contact.efc_address >= 0
        pressed[pressed] = self._data.efc_force[contact.efc_address[pressed]] > 0.0
        on_floor = rows[:, 0] == _FLOOR
        touches = []
        for which in np.flatnonzero(pressed & ~on_floor & (rows[:, 1] >= 0)).tolist():
            low, high = rows[which].tolist()
            vehicle, other = (high, None) if low == _SOLID else (low, high)
            if vehicle < self._count:
                touches.append(Touch(vehicle, other, tuple(contact.pos[which].tolist())))
        return sorted(_inside(touches), key=lambda each: each.key), {*rows[pressed & on_floor, 1].tolist()}

    def _rows_of_geoms(self) -> Array:
        """Row of the vehicle or other body of each shape; links of a robot belong to its root."""
        model, names = self._model, mj.mjtObj.mjOBJ_BODY
        rows = np.full(model.ngeom, _SOLID)
        for geom, body in enumerate(model.geom_bodyid.tolist()):
            if body:
                rows[geom] = int(mj.mj_id2name(model, names, model.body_rootid[body]))
        rows[_FLOOR_GEOM] = _FLOOR
        return rows


def _inside(touches: Sequence[Touch]) -> list[Touch]:
    """The contacts of each pair, moved together by a hundredth, so that contacts of a face lie inside it, not on its edges."""
    places: dict[tuple[int, int], list[Vec3]] = {}
    for each in touches:
        places.setdefault(each.key, []).append(each.place)
    middles = {key: np.mean(points, axis=0) for key, points in places.items()}
    moved = [each.place + 0.01 * (middles[each.key] - each.place) for each in touches]
    return [each._replace(place=tuple(place.tolist())) for each, place in zip(touches, moved, strict=True)]


def _add_quadrotor(builder: Builder, name: str, spec: VehicleSpec) -> None:
    model: Any = spec.model
    body = builder.add_body(name, model.hull, model.mass_kg, spec.start, spec.heading, _FRICTION, steps=MOTOR_STEPS)
    set_inertia(body, model.mass_kg, (0.0, 0.0, 0.0), model.inertia)


def _compiled(spec: Any) -> tuple[Any, Any]:
    mj.set_mju_user_warning(_ignored)  # else MuJoCo writes a file into the current folder; see `MujocoEngine.advance`
    model = spec.compile()
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    return model, data


def _ignored(text: str) -> None:
    """Ignore a warning."""


class _Free:
    """Free bodies of a model by their names, which are rows; states as arrays (n, ...)."""

    def __init__(self, model: Any, data: Any, rows: Sequence[int]) -> None:
        self.bodies = [mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, f"{row}") for row in rows]
        joints = model.body_jntadr[self.bodies]
        self._qpos, self._qvel = data.qpos, data.qvel
        self._pos = model.jnt_qposadr[joints].reshape(-1, 1) + np.arange(7)
        self._vel = model.jnt_dofadr[joints].reshape(-1, 1) + np.arange(6)

    def read(self) -> tuple[Array, Array, Array, Array]:
        """Position (n, 3) m, velocity (n, 3) m/s, world; attitude (n, 4); angular velocity (n, 3) rad/s, body."""
        pos, vel = self._qpos[self._pos], self._qvel[self._vel]
        return pos[:, :3], vel[:, :3], pos[:, 3:], vel[:, 3:]

    def write(self, position: Array, velocity: Array, attitude: Array, rate: Array) -> None:
        """Set the state; arrays as in `read`."""
        self._qpos[self._pos] = np.concatenate([position, attitude], axis=1)
        self._qvel[self._vel] = np.concatenate([velocity, rate], axis=1)


class _Movables(_Free):
    """Movables. One that rests keeps its pose to the last bit, though in MuJoCo it trembles."""

    def __init__(self, model: Any, data: Any, rows: Sequence[int]) -> None:
        super().__init__(model, data, rows)
        self._rests, self._pose = np.zeros(len(rows), bool), self._qpos[self._pos]

    def look(self) -> None:
        """Find which rest, at fixed times."""
        if self.bodies:
            pose = self._qpos[self._pos]
            slow = np.abs(self._qvel[self._vel]).max(axis=1) < _RESTS
            stays = self._rests & slow & (np.abs(pose - self._pose).max(axis=1) < _TREMBLES)
            self._rests, self._pose = slow, np.where(stays[:, None], self._pose, pose)

    def read(self) -> tuple[Array, Array, Array, Array]:
        """State, as `_Free.read`."""
        rests = self._rests[:, None]
        pose, vel = np.where(rests, self._pose, self._qpos[self._pos]), np.where(rests, 0.0, self._qvel[self._vel])
        return pose[:, :3], vel[:, :3], pose[:, 3:], vel[:, 3:]

    def put(self, number: int, place: Vec3, attitude: tuple[float, float, float, float]) -> None:
        """Put one at rest at a place; others that leaned on it may fall."""
        self._qpos[self._pos[number]] = (*place, *attitude)
        self._qvel[self._vel[number]] = 0.0
        self._rests[:] = False


class _Robots:
    """Ground robots, in the order of ``specs`` by row."""

    def __init__(self, model: Any, data: Any, specs: Mapping[int, VehicleSpec], world: World) -> None:
        models: list[Any] = [spec.model for spec in specs.values()]
        self.place_of = {row: place for place, row in enumerate(specs)}
        self.firmware = Firmware(models)
        self._model, self._data, self._world = model, data, world
        self.bodies = _Free(model, data, [*specs])
        self.sunk = np.zeros(len(models))  # m, into the floor at rest: left out of heights
        joints = [mj.mj_name2id(model, mj.mjtObj.mjOBJ_JOINT, f"{row}/{side}") for row in specs for side in ("left", "right")]
        self._angle, self._dof = model.jnt_qposadr[joints].reshape(-1, 2), model.jnt_dofadr[joints].reshape(-1, 2)
        self._signs, self._axle = np.ones((len(models), 2)), np.zeros((len(models), 3))
        for place, each in enumerate(models):
            if isinstance(each, UrdfDrive):
                self._signs[place], self._axle[place] = each.plan.signs, each.plan.axle
        self._sizes = [(each.wheel_radius_m, 0.5 * each.track_m) for each in models]
        self.odometry = DifferentialOdometry(self._sizes, specs.values())
        # Of the speeds that the motors hold: order among the constraints is that of the joints.
        self._order, self._speeds = np.argsort(self._dof.ravel()), np.zeros((len(models), 2))
        self._rate = 2.0 / (MOTOR_IMPEDANCE * MOTOR_STEPS * model.opt.timestep)  # 1/s, see `drive`
        self._before: Array | None = None
        self._zones = _Zones(model, [*specs], world) if world.zones and specs else None
        if self._zones:
            self._zones.scale(self.bodies.read()[0])

    def cycle(self, step_s: float) -> None:
        """One cycle of the firmware, before a step."""
        for place, v, w in self.firmware.cycle(step_s):
            radius, half_track = self._sizes[place]
            across = w * half_track
            self._speeds[place] = (v - across) / radius, (v + across) / radius

    def save_velocities(self) -> None:
        """Save the velocities before a step, for its accelerations; without this call they are zero."""
        self._before = self._reference()[1]

    def drive(self) -> None:
        """Move the reference of the motors' constraints from speed 0 to the wanted speeds, after the first half of a step.

        Their reference acceleration is -b (speed - 0), b = 2 / (dmax time constant): MuJoCo, "Computation", reference.
        """
        if self.place_of:
            first = self._data.ne
            speeds = (self._signs * self._speeds).ravel()[self._order]
            self._data.efc_aref[first : first + len(speeds)] += self._rate * speeds

    def encode(self) -> None:
        """Read the encoders; a robot in another zone of the floor gets its friction."""
        if self.place_of:
            self.odometry.encode(self._signs * self._data.qpos[self._angle])
            if self._zones:
                self._zones.scale(self.bodies.read()[0])

    def read(self) -> BodyMotion:
        """Motion of every robot."""
        position, velocity, attitude, rate = self._reference()
        angles, rates = (self._signs * each for each in (self._data.qpos[self._angle], self._data.qvel[self._dof]))
        before = velocity if self._before is None else self._before
        acceleration = (velocity - before) / self._model.opt.timestep
        return BodyMotion(position, velocity, attitude, rate, acceleration, angles, self.odometry.now(angles, rates))

    def _reference(self) -> tuple[Array, Array, Array, Array]:
        """Motion of the reference points."""
        position, velocity, attitude, rate = self.bodies.read()
        turned = rotations(attitude)
        axle = np.einsum("nij,nj->ni", turned, self._axle)
        swept = np.einsum("nij,nj->ni", turned, np.cross(rate, self._axle))
        axle[:, 2] -= self.sunk
        return position + axle, velocity + swept, attitude, rate


class _Zones:
    """Friction of robots by the zone of the floor that they are in."""

    def __init__(self, model: Any, rows: Sequence[int], world: World) -> None:
        self._model, self._world = model, world
        roots = [mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, f"{row}") for row in rows]
        self._geoms = [np.flatnonzero(model.body_rootid[model.geom_bodyid] == root) for root in roots]
        self._own = [model.geom_friction[geoms, 0].copy() for geoms in self._geoms]

    def scale(self, position: Array) -> None:
        """Set the friction of every robot."""
        for (x, y, _), geoms, own in zip(position.tolist(), self._geoms, self._own, strict=True):
            self._model.geom_friction[geoms, 0] = own * self._world.friction_at(x, y)


class _Flyers:
    """Quadrotors, in the order of ``specs`` by row."""

    def __init__(self, model: Any, data: Any, specs: Mapping[int, VehicleSpec], gravity: float, gusts: Gusts) -> None:
        self.place_of = {row: place for place, row in enumerate(specs)}
        self.fleet = fleet_of(specs.values(), gravity)
        self._data, self._bodies, self._gusts, self._step_s = data, _Free(model, data, [*specs]), gusts, model.opt.timestep

    def push(self, now_ns: int, step_s: float) -> None:
        """Before a step: put the bodies where the fleet is, with the forces of the step, and move the fleet as in free air."""
        if not self.place_of:
            return
        fleet = self.fleet
        self._bodies.write(fleet.position, fleet.velocity, fleet.attitude, fleet.rate)
        force, torque = fleet.wrench(step_s, self._gusts.advance(now_ns))
        self._data.xfrc_applied[self._bodies.bodies] = np.concatenate([force, torque], axis=1)
        fleet.integrate(force, torque, step_s)

    def take(self, rows: Collection[int | None]) -> None:
        """After a step: take the states of the quadrotors among these rows, which are in contact."""
        places = sorted(place for row, place in self.place_of.items() if row in rows)
        if places:
            state = self.fleet.position, self.fleet.velocity, self.fleet.attitude, self.fleet.rate
            for own, simulated in zip(state, self._bodies.read(), strict=True):
                own[places] = simulated[places]

    def read(self) -> BodyMotion:
        """Motion of every quadrotor."""
        return flown(self.fleet, self._step_s)
