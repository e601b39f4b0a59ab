"""External vehicles in Bullet: bodies that push other bodies and are never pushed."""

import math

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.bullet import SOLID
from vcmvsp.physics.dynamics.bullet.body_builder import hull_shape, rigid_body
from vcmvsp.physics.dynamics.bullet.world_bodies import HEAVY_KG, set_poses
from vcmvsp.physics.dynamics.external_vehicles import ExternalVehicles
from vcmvsp.physics.world.solids import Hull

_FRICTION = 0.5  # of the hulls, assumed
_SLIDES = 0.5  # m/s, greatest extra speed of a body behind a jump of its pose: bodies in its way are pushed aside
_JUMPS_M = 1.0  # a body further off is put in place at once, and throws out bodies in its way


class ExternalBodies:
    """A body with the hull of each external vehicle, put in place before every step.

    After a jump of the pose, e.g. by a corrected estimate, the body slides there. The upward speed makes up for a step of
    gravity in Bullet: a body in contact is not dragged down.
    """

    def __init__(self, client: int, external: ExternalVehicles, hulls: list[Hull], *, gravity: float, step_s: float) -> None:
        self._client, self._external, self._lift, self._step_s = client, external, gravity * step_s, step_s
        self._at = external.read().position
        self.bodies = []
        for hull in hulls:
            shape = hull_shape(client, hull.kind, hull.size, collisionFramePosition=hull.offset)
            self.bodies.append(rigid_body(client, HEAVY_KG, shape, _FRICTION, SOLID))  # without contact to the floor
        self._reach = np.array([0.5 * math.hypot(*hull.size) + math.hypot(*hull.offset) for hull in hulls])

    def place(self, now_ns: int) -> None:
        """Put the bodies in place with their velocities."""
        now, yaw_rates = self._external.at(now_ns)
        short = now.position - self._at
        far = np.sqrt((short * short).sum(axis=1, keepdims=True))
        share = np.where(far > _JUMPS_M, 1.0, np.minimum(1.0, _SLIDES * self._step_s / np.maximum(far, 1e-300)))
        here = self._at + share * short
        self._at = here + self._step_s * now.velocity  # before the next step, without a jump
        spin = np.zeros_like(now.velocity)
        spin[:, 2] = yaw_rates
        lifted = now.velocity + np.array([0.0, 0.0, self._lift])
        set_poses(self._client, self.bodies, now._replace(position=here, velocity=lifted, angular_velocity=spin))

    def spheres(self, now_ns: int, span_s: float) -> tuple[Array, Array]:
        """Positions (k, 3) m, and radii of spheres around them that the bodies do not leave within ``span_s``, (k,) m."""
        velocity = self._external.at(now_ns)[0].velocity
        return self._at, self._reach + span_s * (_SLIDES + np.sqrt((velocity * velocity).sum(axis=1)))
