"""Paths of the bodies of external vehicles: they follow the received motion, and slide where it jumps."""

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.engine import BodyMotion
from vcmvsp.physics.dynamics.kinematic import ExternalEngine

SLIDES = 0.5  # m/s, greatest extra speed of a body behind a jump of its pose: bodies in its way are pushed aside
_JUMPS_M = 1.0  # a body further off is put in place at once, and throws out bodies in its way


class ExternalPath:
    """Motion of one body for each external vehicle, in steps of ``step_s``.

    After a jump of the pose, e.g. by a corrected estimate, the body slides there.
    """

    def __init__(self, external: ExternalEngine, step_s: float) -> None:
        self._external, self._step_s = external, step_s
        self.position: Array = external.read().position  # (k, 3) m, before the next step, without a jump

    def step(self, now_ns: int) -> BodyMotion:
        """Motion in the step that begins now; angular velocities in the world frame."""
        now, yaw_rates = self._external.at(now_ns)
        short = now.position - self.position
        far = np.sqrt((short * short).sum(axis=1, keepdims=True))
        share = np.where(far > _JUMPS_M, 1.0, np.minimum(1.0, SLIDES * self._step_s / np.maximum(far, 1e-300)))
        position = self.position + share * short
        self.position = position + self._step_s * now.velocity
        spin = np.zeros_like(now.velocity)
        spin[:, 2] = yaw_rates
        return now._replace(position=position, angular_velocity=spin)

    def speeds(self, now_ns: int) -> Array:
        """Greatest speeds of the bodies, (k,) m/s."""
        velocity = self._external.at(now_ns)[0].velocity
        return SLIDES + np.sqrt((velocity * velocity).sum(axis=1))
