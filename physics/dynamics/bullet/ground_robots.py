"""Ground robots in Bullet: wheels that roll and slip, motors of limited torque, wheel encoders.

The firmware moves the set points of (v, w) towards the command once a step; motors hold the wheels at the speeds of the set
points. Wheel encoders are read 40 times a second, independent of publications. At these ticks a robot in another zone of the
floor gets the friction of that zone.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.bullet import p, turned
from vcmvsp.physics.dynamics.bullet.bodies import (
    LEFT,
    RIGHT,
    BaseState,
    base_states,
    differential_drive,
    finish,
    floor_friction,
    motion_of,
)
from vcmvsp.physics.dynamics.engine import BodyMotion
from vcmvsp.physics.dynamics.kinematic import Firmware
from vcmvsp.physics.dynamics.odometry import DifferentialOdometry
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World


class _Wheels(NamedTuple):
    body: int
    joints: tuple[int, int]
    signs: tuple[float, float]  # -1: the joint's axis points to the right
    radius_m: float
    half_track_m: float
    forces: tuple[float, float]  # N m


_Joints = tuple[tuple[float, ...], tuple[float, ...]]  # left and right wheel: rad, rad/s, and more


class GroundRobots:
    """n ground robots, a row each."""

    def __init__(self, client: int, world: World, specs: Sequence[VehicleSpec], step_s: float) -> None:
        models: list[Any] = [spec.model for spec in specs]
        self._client, self._step_s = client, step_s
        self.firmware = Firmware(models)
        built = [_build(client, model, spec.start, spec.heading) for model, spec in zip(models, specs, strict=True)]
        self._wheels = [wheels for wheels, _ in built]
        self.bodies = [each.body for each in self._wheels]
        # From the centres of mass to the reference points, body frame.
        self._references = np.array([reference for _, reference in built], float).reshape(len(specs), 3)
        self._twice = np.concatenate([self._references, self._references])
        self._signs = np.array([each.signs for each in self._wheels], float).reshape(len(specs), 2)
        self._odometry = DifferentialOdometry([(each.radius_m, each.half_track_m) for each in self._wheels], specs)
        self._joints: list[_Joints] = []  # cache, until the next step
        self._before: list[BaseState] = []  # states before the last step, for accelerations
        for row in range(len(specs)):
            self._drive(row, 0.0, 0.0)  # motors hold the wheels from the start
        self._zones = _Zones(client, world, self._wheels) if world.zones and specs else None
        if self._zones:
            self._zones.scale()

    def cycle(self) -> None:
        """One cycle of the firmware, before a step."""
        self._joints = []
        for row, v, w in self.firmware.cycle(self._step_s):
            self._drive(row, v, w)

    def _drive(self, row: int, v: float, w: float) -> None:
        """Set the wheel speeds of the motors for (v, w): ``(v -+ w track / 2) / radius``."""
        body, joints, (sign_left, sign_right), radius, half_track, forces = self._wheels[row]
        across = w * half_track
        speeds = (sign_left * (v - across) / radius, sign_right * (v + across) / radius)
        p.setJointMotorControlArray(
            body, joints, p.VELOCITY_CONTROL, targetVelocities=speeds, forces=forces, physicsClientId=self._client
        )

    def encode(self) -> None:
        """Read the encoders, and update the odometry."""
        self._odometry.encode(self._turns(0))
        if self._zones:
            self._zones.scale()

    def read(self) -> BodyMotion:
        """Motion of every robot, and its wheel odometry up to now; reading changes nothing."""
        angles = self._turns(0)
        return self._reference_motion()._replace(wheels=angles, odometry=self._odometry.now(angles, self._turns(1)))

    def _turns(self, which: int) -> Array:
        """Angles (0), rad, or rates (1), rad/s, of the left and right wheels, (n, 2); forwards is positive."""
        states = self._joint_states()
        return self._signs * np.array([(left[which], right[which]) for left, right in states]).reshape(len(states), 2)

    def _joint_states(self) -> list[_Joints]:
        if not self._joints:
            states, client = p.getJointStates, self._client
            self._joints = [states(each.body, each.joints, client) for each in self._wheels]
        return self._joints

    def save_velocities(self) -> None:
        """Save the states before a step, for its accelerations; without this call they are zero."""
        self._before = base_states(self._client, self.bodies)

    def _reference_motion(self) -> BodyMotion:
        n, now = len(self.bodies), base_states(self._client, self.bodies)
        if not self._before:
            return motion_of(now, self._references)
        both = motion_of([*now, *self._before], self._twice)  # at once: little more work than one
        acceleration = (both.velocity[:n] - both.velocity[n:]) / self._step_s
        return BodyMotion(*(each[:n] for each in both))._replace(acceleration=acceleration)


def _build(client: int, model: DifferentialDrive | UrdfDrive, position: Vec3, heading: float) -> tuple[_Wheels, Vec3]:
    """Build a robot; also returns its reference point in the frame of its centre of mass, m."""
    forces = (model.torque, model.torque)
    if isinstance(model, DifferentialDrive):
        body = differential_drive(client, model, position, heading)
        reference = (model.mass_behind_m, 0.0, -model.mass_height_m)
        return _Wheels(body, (LEFT, RIGHT), (1.0, 1.0), model.wheel_radius_m, 0.5 * model.track_m, forces), reference
    axle = model.plan.axle  # the reference point, in the frame of the root link, which is level
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = position[0] - cos * axle[0] + sin * axle[1], position[1] - sin * axle[0] - cos * axle[1]
    flags = p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_IMPLICIT_CYLINDER
    body = p.loadURDF(str(model.plan.path), (x, y, -axle[2]), turned(heading), flags=flags, physicsClientId=client)
    names = [p.getJointInfo(body, joint, client)[1].decode() for joint in range(p.getNumJoints(body, client))]
    joints = (names.index(model.left_wheel), names.index(model.right_wheel))
    finish(client, body, wheels=joints, wheel_friction=model.wheel_friction, friction=model.body_friction)
    centre = p.getDynamicsInfo(body, -1, client)[3]
    reference = (axle[0] - centre[0], axle[1] - centre[1], axle[2] - centre[2])
    return _Wheels(body, joints, model.plan.signs, model.plan.wheel_radius_m, 0.5 * model.plan.track_m, forces), reference


class _Zones:
    """Sets the friction of robots by the zone of their centre of mass, without the floor's, which Bullet multiplies in."""

    def __init__(self, client: int, world: World, robots: Sequence[_Wheels]) -> None:
        self._client, self._world, self._floor = client, world, floor_friction(world)
        self._frictions: dict[int, list[float]] = {}  # by body: own friction of base and links
        for body, *_ in robots:
            links = range(-1, p.getNumJoints(body, client))
            self._frictions[body] = [p.getDynamicsInfo(body, link, client)[1] for link in links]
        self._present = dict.fromkeys(self._frictions, self._floor)

    def scale(self) -> None:
        """Set the friction of every robot that has entered another zone."""
        for body, frictions in self._frictions.items():
            (x, y, _), _ = p.getBasePositionAndOrientation(body, self._client)
            zone = self._world.friction_at(x, y, self._floor)
            if zone != self._present[body]:
                self._present[body] = zone
                for link, own in enumerate(frictions, -1):
                    p.changeDynamics(body, link, lateralFriction=own * zone / self._floor, physicsClientId=self._client)
