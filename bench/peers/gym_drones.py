"""gym-pybullet-drones, by its fork on PyPI: quadrotors in PyBullet with commanded velocities.

``--agents``, ``--span_s``. Bullet steps at 240 Hz and the controllers at 48 Hz, as in its example of velocities.
"""

from collections.abc import Callable

import numpy as np
from gym_pybullet_drones.envs.VelocityAviary import VelocityAviary  # type: ignore[import-not-found]
from gym_pybullet_drones.utils.enums import DroneModel  # type: ignore[import-not-found]

from bench.peers.pace import Options, stretches

CONTROL_HZ = 48


def fleet(settings: Options) -> Callable[[], None]:
    """A fleet in the air; each call continues the flight."""
    count = settings.agents
    places = np.array([(3.0 * (n % 10), 3.0 * (n // 10), 5.0) for n in range(count)])
    air = VelocityAviary(DroneModel.CF2X, count, initial_xyzs=places, pyb_freq=240, ctrl_freq=CONTROL_HZ)
    air.reset(seed=1)
    steps = 0

    def fly() -> None:
        nonlocal steps
        for _ in range(round(CONTROL_HZ * settings.span_s)):
            turn = 1.0 if steps // CONTROL_HZ % 2 else -1.0
            observations, *_ = air.step(np.tile((turn, 0.5 * turn, 0.0, 1.0), (count, 1)))
            steps += 1
        assert np.all(abs(observations[:, 2] - 5.0) < 1.0), observations[:, 2]  # they do fly

    return fly


if __name__ == "__main__":
    stretches(fleet)
