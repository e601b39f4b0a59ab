"""Differential-drive robots as bodies in Bullet: wheels that roll and slip, motors of limited torque, walls that stop them.

How a robot is built, and why:

* Wheels are spheres. They touch the floor in one point at the middle of the tread; cylinders become polyhedra in Bullet and
  cost twice the time, and track worse. They collide with the floor only, for a sphere is wider than the wheel it stands for.
* The caster is a second shape of the base, nearly without friction: no further joint.
* All boxes of the world are one triangle mesh: a step costs the same with one box as with hundreds.
* Bullet's default damping of bodies and joints is switched off: there is no air or oil in the parameters.

The firmware moves the set points of (v, w) towards the command once a step; motors hold the wheels at the speeds of the set
points. Wheel encoders are read 40 times a second, whoever looks on: what is published never depends on how often.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from cosim.clock import Ticks
from cosim.frames import arc, wrap
from cosim.types import Odometry, Vec3, VehicleState
from physics.vehicles import DifferentialDrive
from physics.world import World


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """PyBullet's C code greets on standard error when it is imported; the file descriptor leads nowhere meanwhile."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _silent_stderr():
    import pybullet as p

# Collision groups: two shapes meet if each one's group is in the other's mask.
_FLOOR, _SOLID, _WHEEL = 1, 2, 4
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # x, y, z, w: Bullet's order, which stays inside this module
_LEFT, _RIGHT = 0, 1  # joints
_WHEELS = [_LEFT, _RIGHT]
_ENCODER_HZ = 40.0


class BulletEngine:
    """Moves differential drives in one Bullet world without a window.

    Args:
        world: floor and boxes.
        models: what the vehicles are.
        poses: where they start: x m, y m, yaw rad. They must not overlap.
        rate_hz: Bullet steps a second; ``advance`` goes to the step nearest to the time asked for.
        iterations: of the constraint solver in each step.
        gravity: m/s2, downwards.
    """

    def __init__(
        self,
        *,
        world: World,
        models: Sequence[DifferentialDrive],
        poses: Sequence[Vec3],
        rate_hz: float,
        iterations: int,
        gravity: float,
    ) -> None:
        self._ticks, self._step, self._step_s = Ticks.rate(rate_hz), 0, 1.0 / rate_hz
        self._encoder_steps = max(1, round(rate_hz / _ENCODER_HZ))
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise RuntimeError("Bullet gave no physics client: too many are open in this process")
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._step_s,
            numSolverIterations=iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )
        p.setGravity(0.0, 0.0, -gravity, physicsClientId=self._client)
        try:
            self._build(world)
            self._robots = [_Robot(self._client, model, pose) for model, pose in zip(models, poses, strict=True)]
        except BaseException:
            self.close()
            raise
        self._vehicle_of = {robot.body: number for number, robot in enumerate(self._robots)}
        self._ramping: list[_Robot] = []  # those whose set points have not reached the command

    def _build(self, world: World) -> None:
        """The floor as a plane, the boxes as one mesh; neither moves."""
        client = self._client
        plane = p.createCollisionShape(p.GEOM_PLANE, planeNormal=(0.0, 0.0, 1.0), physicsClientId=client)
        self._floor = p.createMultiBody(0.0, plane, physicsClientId=client)
        p.changeDynamics(self._floor, -1, lateralFriction=world.floor_friction, physicsClientId=client)
        p.setCollisionFilterGroupMask(self._floor, -1, _FLOOR, _SOLID | _WHEEL, physicsClientId=client)
        if world.boxes:
            vertices, indices = world.mesh()
            mesh = p.createCollisionShape(
                p.GEOM_MESH, vertices=vertices, indices=indices, flags=p.GEOM_FORCE_CONCAVE_TRIMESH, physicsClientId=client
            )
            body = p.createMultiBody(0.0, mesh, physicsClientId=client)
            p.setCollisionFilterGroupMask(body, -1, _SOLID, _SOLID, physicsClientId=client)

    def command(self, vehicle: int, v: float, w: float) -> None:
        """From now on move at ``v`` m/s forward and ``w`` rad/s, as soon as the firmware's ramps allow."""
        robot = self._robots[vehicle]
        robot.command(v, w)
        if robot not in self._ramping:
            self._ramping.append(robot)

    def advance(self, to_ns: int) -> None:
        """Step on to the Bullet step nearest to ``to_ns``."""
        ticks = self._ticks
        until = (to_ns * ticks.per + ticks.ns // 2) // ticks.ns
        step, client = p.stepSimulation, self._client
        while self._step < until:
            if self._ramping:
                self._ramping = [robot for robot in self._ramping if not robot.ramp(self._step_s)]
            step(client)
            self._step += 1
            if self._step % self._encoder_steps == 0:
                for robot in self._robots:
                    robot.integrate()

    def read(self) -> list[tuple[VehicleState, Odometry]]:
        """The true state and the wheels' account of every vehicle, now."""
        return [(robot.state(), robot.odometry()) for robot in self._robots]

    def touching(self) -> list[tuple[int, int | None]]:
        """Pairs of vehicles that press against each other in this step; None stands for the world's boxes."""
        pairs: set[tuple[int, int | None]] = set()
        for number, robot in enumerate(self._robots):
            for contact in p.getContactPoints(bodyA=robot.body, linkIndexA=-1, physicsClientId=self._client):
                body, force = contact[2], contact[9]
                if force > 0.0 and body != self._floor:
                    other = self._vehicle_of.get(body)
                    pairs.add((number, None) if other is None else (min(number, other), max(number, other)))
        return sorted(pairs, key=lambda pair: (pair[0], -1 if pair[1] is None else pair[1]))

    def close(self) -> None:
        """Give the Bullet world back."""
        if self._client >= 0:
            p.disconnect(self._client)
            self._client = -1


class _Encoders(NamedTuple):
    """What the wheels said last, and the pose reckoned from it."""

    left: float  # rad, since the start
    right: float
    pose: Vec3


class _Robot:
    """One differential drive: its body, its firmware and its odometry."""

    def __init__(self, client: int, model: DifferentialDrive, pose: Vec3) -> None:
        self.model, self._client = model, client
        self.body = _create(client, model, pose)
        # Bullet speaks of the centre of mass; this leads from there to the reference point, body frame.
        self._reference = (model.mass_behind_m, 0.0, -model.mass_height_m)
        self._set = self._command = (0.0, 0.0)
        self._drive(0.0, 0.0)  # motors hold the wheels from the start
        self._seen = _Encoders(0.0, 0.0, pose)

    def command(self, v: float, w: float) -> None:
        """What the set points are to reach, within the greatest speeds."""
        max_v, max_w = self.model.max_speed, self.model.max_yaw_rate
        self._command = max(-max_v, min(v, max_v)), max(-max_w, min(w, max_w))

    def ramp(self, dt: float) -> bool:
        """One cycle of the firmware; true when the set points have reached the command."""
        m, (v, w) = self.model, self._set
        v = _towards(v, self._command[0], m.accel * dt, m.decel * dt)
        w = _towards(w, self._command[1], m.yaw_accel * dt, m.yaw_accel * dt)
        if (v, w) != self._set:
            self._drive(v, w)
        self._set = v, w
        return self._set == self._command

    def _drive(self, v: float, w: float) -> None:
        """Have the motors turn the wheels at the speeds of (v, w): ``(v -+ w track / 2) / radius``, from now on."""
        m = self.model
        across = 0.5 * w * m.track_m
        speeds = ((v - across) / m.wheel_radius_m, (v + across) / m.wheel_radius_m)
        p.setJointMotorControlArray(
            self.body,
            _WHEELS,
            p.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=(m.torque, m.torque),
            physicsClientId=self._client,
        )

    def integrate(self) -> None:
        """Take the encoders' readings into the odometry."""
        (left, *_), (right, *_) = p.getJointStates(self.body, _WHEELS, self._client)
        self._seen = _Encoders(left, right, self._reckon(left, right))

    def odometry(self) -> Odometry:
        """The wheels' account up to now; looking changes nothing."""
        (left, left_speed, *_), (right, right_speed, *_) = p.getJointStates(self.body, _WHEELS, self._client)
        x, y, yaw = self._reckon(left, right)
        radius = self.model.wheel_radius_m
        v, w = 0.5 * radius * (right_speed + left_speed), radius * (right_speed - left_speed) / self.model.track_m
        return Odometry(pose=(x, y, wrap(yaw)), v=v, w=w)

    def _reckon(self, left: float, right: float) -> Vec3:
        """The last pose, continued by the arc that the wheels have rolled since."""
        radius, seen = self.model.wheel_radius_m, self._seen
        rolled_left, rolled_right = radius * (left - seen.left), radius * (right - seen.right)
        return arc(seen.pose, 0.5 * (rolled_left + rolled_right), (rolled_right - rolled_left) / self.model.track_m, 1.0)

    def state(self) -> VehicleState:
        """The true state of the reference point."""
        centre, turned = p.getBasePositionAndOrientation(self.body, self._client)
        velocity, spin = p.getBaseVelocity(self.body, self._client)
        a, b, c, d, e, f, g, h, i = p.getMatrixFromQuaternion(turned)  # world_from_body, by rows
        rx, _, rz = self._reference
        to_x, to_y, to_z = a * rx + c * rz, d * rx + f * rz, g * rx + i * rz  # centre of mass to reference point, world
        wx, wy, wz = spin
        qx, qy, qz, qw = turned
        return VehicleState(
            position=(centre[0] + to_x, centre[1] + to_y, centre[2] + to_z),
            velocity=(
                velocity[0] + wy * to_z - wz * to_y,
                velocity[1] + wz * to_x - wx * to_z,
                velocity[2] + wx * to_y - wy * to_x,
            ),
            attitude=(qw, qx, qy, qz),
            angular_velocity=(a * wx + d * wy + g * wz, b * wx + e * wy + h * wz, c * wx + f * wy + i * wz),
        )


def _towards(speed: float, wanted: float, up: float, down: float) -> float:
    """The speed one cycle on: at most ``up`` away from standstill, ``down`` towards it, and never past it in one cycle."""
    if speed * wanted < 0.0:
        wanted = 0.0
    change = wanted - speed
    most = down if abs(wanted) < abs(speed) else up
    return wanted if abs(change) <= most else speed + (most if change > 0.0 else -most)


def _create(client: int, m: DifferentialDrive, pose: Vec3) -> int:
    """Build one robot at (x m, y m, yaw rad). The base frame lies on the floor below the axle; links 0, 1 are the wheels."""
    x, y, yaw = pose
    hull_height = m.height_m - m.clearance_m
    caster_radius = 0.5 * m.clearance_m
    base = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_BOX, p.GEOM_SPHERE],
        halfExtents=[[0.5 * m.length_m, 0.5 * m.width_m, 0.5 * hull_height], [0.0, 0.0, 0.0]],
        radii=[0.0, caster_radius],
        collisionFramePositions=[
            [-m.axle_ahead_m, 0.0, m.clearance_m + 0.5 * hull_height],
            [-m.caster_behind_m, 0.0, caster_radius],
        ],
        physicsClientId=client,
    )
    wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=m.wheel_radius_m, physicsClientId=client)
    base_mass = m.mass_kg - 2.0 * m.wheel_mass_kg
    body: int = p.createMultiBody(
        baseMass=base_mass,
        baseCollisionShapeIndex=base,
        basePosition=(x, y, 0.0),
        baseOrientation=p.getQuaternionFromEuler((0.0, 0.0, yaw)),
        baseInertialFramePosition=(-m.mass_behind_m, 0.0, m.mass_height_m),
        linkMasses=[m.wheel_mass_kg] * 2,
        linkCollisionShapeIndices=[wheel] * 2,
        linkVisualShapeIndices=[-1] * 2,
        linkPositions=[(0.0, side * 0.5 * m.track_m, m.wheel_radius_m) for side in (1, -1)],
        linkOrientations=[_UPRIGHT] * 2,
        linkInertialFramePositions=[(0.0, 0.0, 0.0)] * 2,
        linkInertialFrameOrientations=[_UPRIGHT] * 2,
        linkParentIndices=[0, 0],
        linkJointTypes=[p.JOINT_REVOLUTE] * 2,
        linkJointAxis=[(0.0, 1.0, 0.0)] * 2,
        physicsClientId=client,
    )
    # Inertia: the body as a solid box, about its middle; a wheel as a disc. Bullet takes both from the shapes otherwise.
    box = tuple(
        base_mass / 12.0 * (u * u + v * v)
        for u, v in ((m.width_m, hull_height), (m.length_m, hull_height), (m.length_m, m.width_m))
    )
    across, axle = 0.25 * m.wheel_mass_kg * m.wheel_radius_m**2, 0.5 * m.wheel_mass_kg * m.wheel_radius_m**2
    for link, friction, inertia in (
        (-1, m.caster_friction, box),
        *((w, m.wheel_friction, (across, axle, across)) for w in _WHEELS),
    ):
        p.changeDynamics(
            body,
            link,
            lateralFriction=friction,
            localInertiaDiagonal=inertia,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            physicsClientId=client,
        )
    p.setCollisionFilterGroupMask(body, -1, _SOLID, _FLOOR | _SOLID, physicsClientId=client)
    for link in _WHEELS:
        p.setCollisionFilterGroupMask(body, link, _WHEEL, _FLOOR, physicsClientId=client)
    return body
