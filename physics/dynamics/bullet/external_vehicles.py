"""Vehicles in Bullet that something else moves: bodies that push, and that nothing pushes."""

import math

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.bullet import SOLID, p
from vcmvsp.physics.dynamics.bullet.world_bodies import HEAVY_KG
from vcmvsp.physics.dynamics.external_vehicles import Reflected
from vcmvsp.physics.engine.interface import Motion
from vcmvsp.physics.world.solids import Hull

_FRICTION = 0.5  # of the hulls, assumed
_SLIDES = 0.5  # m/s: as fast a body follows where the pose that was told jumps, so that whoever stands there is pushed aside
_JUMPS_M = 1.0  # farther off it is put there at once, and throws out whoever stands there


class Shown:
    """A body of the shape of its hull for each of ``reflected``, put before every step where that says it is.

    Where what is told jumps, because an estimate was mended, the body slides there. A step of Bullet lets bodies fall; these
    are given the speed upwards that this takes away, so that whoever touches one is not dragged down.
    """

    def __init__(self, client: int, reflected: Reflected, hulls: list[Hull], *, gravity: float, step_s: float) -> None:
        self._client, self._reflected, self._lift, self._step_s = client, reflected, gravity * step_s, step_s
        self._at = reflected.read().position
        self.bodies = [self._build(hull) for hull in hulls]
        self._reach = np.array([0.5 * math.hypot(*hull.size) + math.hypot(*hull.offset) for hull in hulls])

    def _build(self, hull: Hull) -> int:
        client, (length, width, height) = self._client, hull.size
        if hull.kind == "cylinder":
            shape = p.createCollisionShape(
                p.GEOM_CYLINDER,
                radius=0.5 * length,
                height=height,
                collisionFramePosition=hull.offset,
                physicsClientId=client,
            )
        else:
            half = [0.5 * length, 0.5 * width, 0.5 * height]
            shape = p.createCollisionShape(
                p.GEOM_BOX, halfExtents=half, collisionFramePosition=hull.offset, physicsClientId=client
            )
        body: int = p.createMultiBody(HEAVY_KG, shape, physicsClientId=client)
        p.changeDynamics(body, -1, lateralFriction=_FRICTION, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
        p.setCollisionFilterGroupMask(body, -1, SOLID, SOLID, physicsClientId=client)  # they do not mind the floor
        return body

    def place(self, now_ns: int) -> None:
        """Put the bodies where they belong at this time, as fast as they go: what they meet is pushed."""
        now, yaw_rates = self._reflected.at(now_ns)
        short = now.position - self._at
        far = np.sqrt((short * short).sum(axis=1, keepdims=True))
        share = np.where(far > _JUMPS_M, 1.0, np.minimum(1.0, _SLIDES * self._step_s / np.maximum(far, 1e-300)))
        here = self._at + share * short
        self._at = here + self._step_s * now.velocity  # before the next step, if nothing else is told
        poses = zip(self.bodies, here.tolist(), now.attitude.tolist(), strict=True)
        speeds = zip(now.velocity.tolist(), yaw_rates.tolist(), strict=True)
        for (body, place, (w, x, y, z)), ((vx, vy, vz), turning) in zip(poses, speeds, strict=True):
            p.resetBasePositionAndOrientation(body, place, (x, y, z, w), self._client)
            p.resetBaseVelocity(body, (vx, vy, vz + self._lift), (0.0, 0.0, turning), self._client)

    def spheres(self, now_ns: int, span_s: float) -> tuple[Array, Array]:
        """Places (k, 3) m, and how far around it each may be within ``span_s``, (k,) m."""
        velocity = self._reflected.at(now_ns)[0].velocity
        return self._at, self._reach + span_s * (_SLIDES + np.sqrt((velocity * velocity).sum(axis=1)))

    def advance(self, to_ns: int) -> None:
        """Let them go on to ``to_ns``."""
        self._reflected.advance(to_ns)

    def read(self) -> Motion:
        """How they move now."""
        return self._reflected.read()
