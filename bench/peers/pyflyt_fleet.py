"""PyFlyt (github.com/jjshoots/PyFlyt): quadrotors in PyBullet, with new setpoints ten times a second.

``--agents``, ``--span_s``.
"""

from collections.abc import Callable

import numpy as np
from PyFlyt.core import Aviary  # type: ignore[import-not-found]

from bench.peers.pace import Options, stretches


def fleet(settings: Options) -> Callable[[], None]:
    """A fleet in the air; each call continues the flight."""
    count = settings.agents
    places = np.array([(3.0 * (n % 10), 3.0 * (n // 10), 5.0) for n in range(count)])
    model = {"drone_model": "primitive_drone"}  # of 1 kg; its Crazyflie costs as much
    air = Aviary(places, np.zeros((count, 3)), "quadx", drone_options=model, seed=1)
    air.set_mode(6)  # velocity over ground, yaw rate, climb
    tenth = round(0.1 / air.step_period)

    def fly() -> None:
        for _ in range(round(10 * settings.span_s)):
            turn = 1.0 if int(air.elapsed_time) % 2 else -1.0
            air.set_all_setpoints(np.tile((turn, 0.5 * turn, 0.2, 0.0), (count, 1)))
            for _ in range(tenth):
                air.step()
        height = np.array([air.state(n)[3, 2] for n in range(count)])
        assert air.physics_hz == 240
        assert np.all(abs(height - 5.0) < 1.0), height  # they do fly

    return fly


if __name__ == "__main__":
    stretches(fleet)
