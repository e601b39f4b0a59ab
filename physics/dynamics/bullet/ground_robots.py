"""Robots that drive, in Bullet: wheels that roll and slip, motors of limited torque, encoders that count what wheels turn.

The firmware moves the set points of (v, w) towards the command once a step; motors hold the wheels at the speeds of the set
points. Wheel encoders are read 40 times a second, whoever looks on: what is published never depends on how often. At those
ticks a robot that has come into another zone of the floor gets the friction of that zone.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet import p, turned
from vcmvsp.physics.dynamics.bullet.body_builder import LEFT, RIGHT, differential_drive, finish
from vcmvsp.physics.dynamics.bullet.world_bodies import BaseState, base_states, floor_friction, motion_of
from vcmvsp.physics.dynamics.firmware import Firmware
from vcmvsp.physics.dynamics.kinematic_ground import wrapped
from vcmvsp.physics.engine.interface import Motion
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World, Zone


class _Wheels(NamedTuple):
    """What the motors of one robot need."""

    body: int
    joints: tuple[int, int]
    signs: tuple[float, float]  # -1: the joint's axis points to the right
    radius_m: float
    half_track_m: float
    forces: tuple[float, float]  # N m


_Joints = tuple[tuple[float, ...], tuple[float, ...]]  # left and right wheel: rad, rad/s, and what else Bullet says of them


class Robots:
    """n driving robots in a row each."""

    def __init__(
        self,
        client: int,
        world: World,
        models: Sequence[DifferentialDrive | UrdfDrive],
        positions: Sequence[Vec3],
        headings: Sequence[float],
        step_s: float,
    ) -> None:
        self._client, self._step_s = client, step_s
        self._firmware = Firmware(models)
        self._wheels: list[_Wheels] = []
        references: list[Vec3] = []  # from the centre of mass, which Bullet speaks of, to the reference point; body frame
        for model, position, heading in zip(models, positions, headings, strict=True):
            made, reference = _made(client, model, position, heading)
            self._wheels.append(made)
            references.append(reference)
        self.bodies = [each.body for each in self._wheels]
        self._references = np.array(references, float).reshape(len(models), 3)
        self._twice = np.concatenate([self._references, self._references])
        self._signs = np.array([each.signs for each in self._wheels], float).reshape(len(models), 2)
        self._radius = np.array([each.radius_m for each in self._wheels])
        self._half_track = np.array([each.half_track_m for each in self._wheels])
        # What the encoders said last, rad, and the pose reckoned from it.
        self._seen = [(0.0, 0.0)] * len(models)
        self._reckoned = [(x, y, yaw) for (x, y, _), yaw in zip(positions, headings, strict=True)]
        self._joints: list[_Joints] = []  # of the wheels since the last step, once somebody has asked
        self._before: list[BaseState] = []  # before the step whose accelerations are wanted
        for row in range(len(models)):
            self._drive(row, 0.0, 0.0)  # motors hold the wheels from the start
        self._zones = _Zones(client, world, self._wheels) if world.zones and models else None
        if self._zones:
            self._zones.scale()

    def command(self, row: int, v: float, w: float) -> None:
        """From now on move at ``v`` m/s forward and ``w`` rad/s, as soon as the firmware's ramps allow."""
        self._firmware.command(row, v, w)

    def cycle(self) -> None:
        """One cycle of the firmware, before a step."""
        self._joints = []
        for row, v, w in self._firmware.cycle(self._step_s):
            self._drive(row, v, w)

    def _drive(self, row: int, v: float, w: float) -> None:
        """Have the motors turn the wheels at the speeds of (v, w): ``(v -+ w track / 2) / radius``, from now on."""
        body, joints, (left, right), radius, half_track, forces = self._wheels[row]
        across = w * half_track
        speeds = (left * (v - across) / radius, right * (v + across) / radius)
        p.setJointMotorControlArray(
            body, joints, p.VELOCITY_CONTROL, targetVelocities=speeds, forces=forces, physicsClientId=self._client
        )

    def encode(self) -> None:
        """Take the encoders' readings into the odometry."""
        now = self._turned()
        for row, (left, right) in enumerate(now):
            turned_to = left[0], right[0]
            self._reckoned[row], self._seen[row] = self._reckon(row, turned_to), turned_to
        if self._zones:
            self._zones.scale()

    def read(self) -> Motion:
        """How every robot moves, and its wheels' account of it up to now; looking changes nothing."""
        n = len(self._wheels)
        states = self._turned()
        rolled = self._signs * np.array([(left[0], right[0]) for left, right in states]).reshape(n, 2)
        turning = self._signs * np.array([(left[1], right[1]) for left, right in states]).reshape(n, 2)
        reckoned = [self._reckon(row, (left[0], right[0])) for row, (left, right) in enumerate(states)]
        odometry = np.empty((n, 5))
        odometry[:, :3] = np.array(reckoned).reshape(n, 3)
        odometry[:, 2] = wrapped(odometry[:, 2])
        odometry[:, 3] = 0.5 * self._radius * (turning[:, 1] + turning[:, 0])
        odometry[:, 4] = 0.5 * self._radius * (turning[:, 1] - turning[:, 0]) / self._half_track
        return self._moved()._replace(wheels=rolled, odometry=odometry)

    def _turned(self) -> list[_Joints]:
        """How far both wheels of every robot have turned, and how fast they do, as Bullet says it."""
        if not self._joints:
            states, client = p.getJointStates, self._client
            self._joints = [states(each.body, each.joints, client) for each in self._wheels]
        return self._joints

    def _reckon(self, row: int, now: tuple[float, float]) -> Vec3:
        """The last pose, continued by the arc that the wheels have rolled since."""
        _, _, (sign_left, sign_right), radius, half_track, _ = self._wheels[row]
        (now_left, now_right), (seen_left, seen_right) = now, self._seen[row]
        left, right = radius * sign_left * (now_left - seen_left), radius * sign_right * (now_right - seen_right)
        return arc(self._reckoned[row], 0.5 * (left + right), 0.5 * (right - left) / half_track, 1.0)

    def note(self) -> None:
        """Have the accelerations over the step that follows ready for whoever reads; without it they are zero."""
        self._before = base_states(self._client, self.bodies)

    def _moved(self) -> Motion:
        """How the reference points move."""
        n, now = len(self.bodies), base_states(self._client, self.bodies)
        if not self._before:
            return motion_of(now, self._references)
        both = motion_of([*now, *self._before], self._twice)  # at once: that is hardly more work than one
        acceleration = (both.velocity[:n] - both.velocity[n:]) / self._step_s
        return Motion(*(each[:n] for each in both))._replace(acceleration=acceleration)


def _made(client: int, model: DifferentialDrive | UrdfDrive, position: Vec3, heading: float) -> tuple[_Wheels, Vec3]:
    """A robot in Bullet, and its reference point seen from its centre of mass."""
    forces = (model.torque, model.torque)
    if isinstance(model, DifferentialDrive):
        body = differential_drive(client, model, position, heading)
        reference = (model.mass_behind_m, 0.0, -model.mass_height_m)
        return _Wheels(body, (LEFT, RIGHT), (1.0, 1.0), model.wheel_radius_m, 0.5 * model.track_m, forces), reference
    axle = model.plan.axle  # the reference point, in the frame of the root link, which is level
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = position[0] - cos * axle[0] + sin * axle[1], position[1] - sin * axle[0] - cos * axle[1]
    body = p.loadURDF(
        str(model.plan.path),
        (x, y, -axle[2]),
        turned(heading),
        flags=p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_IMPLICIT_CYLINDER,
        physicsClientId=client,
    )
    names = [p.getJointInfo(body, joint, client)[1].decode() for joint in range(p.getNumJoints(body, client))]
    joints = (names.index(model.left_wheel), names.index(model.right_wheel))
    finish(client, body, wheels=joints, wheel_friction=model.wheel_friction, friction=model.body_friction)
    centre = p.getDynamicsInfo(body, -1, client)[3]
    reference = (axle[0] - centre[0], axle[1] - centre[1], axle[2] - centre[2])
    return _Wheels(body, joints, model.plan.signs, model.plan.wheel_radius_m, 0.5 * model.plan.track_m, forces), reference


class _Zones:
    """Gives robots the friction of where their centre of mass is; the floor's, by which Bullet multiplies, is divided out."""

    def __init__(self, client: int, world: World, robots: Sequence[_Wheels]) -> None:
        self._client, self._zones, self._floor = client, world.zones, floor_friction(world)
        self._links = [
            [(link, p.getDynamicsInfo(each.body, link, client)[1]) for link in range(-1, p.getNumJoints(each.body, client))]
            for each in robots
        ]
        self._bodies = [each.body for each in robots]
        self._present = [self._floor] * len(robots)

    def scale(self) -> None:
        """Give every robot that came into another zone the friction there."""
        for row, body in enumerate(self._bodies):
            (x, y, _), _ = p.getBasePositionAndOrientation(body, self._client)
            friction = self._at(x, y)
            if friction != self._present[row]:
                self._present[row] = friction
                for link, own in self._links[row]:
                    p.changeDynamics(body, link, lateralFriction=own * friction / self._floor, physicsClientId=self._client)

    def _at(self, x: float, y: float) -> float:
        return next((zone.friction for zone in reversed(self._zones) if _inside(zone, x, y)), self._floor)


def _inside(zone: Zone, x: float, y: float) -> bool:
    dx, dy = x - zone.center[0], y - zone.center[1]
    cos, sin = math.cos(zone.yaw_rad), math.sin(zone.yaw_rad)
    return abs(cos * dx + sin * dy) <= 0.5 * zone.size[0] and abs(cos * dy - sin * dx) <= 0.5 * zone.size[1]
