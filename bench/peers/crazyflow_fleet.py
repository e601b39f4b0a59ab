"""crazyflow (github.com/learnsyslab/crazyflow): quadrotors in JAX, each given a position and a velocity ten times a second.

``--agents``, ``--span_s``. One thread of one core; dynamics, attitude and motors at 250 Hz, positions at 100 Hz, its defaults.
"""

import os
import sys
from collections.abc import Callable

import numpy as np

from bench.peers.pace import Options, stretches

RATE_HZ = 250
SPEED = 0.3  # m/s; its controller tips over if 1 m/s are reversed at once, which costs as much


def fleet(settings: Options) -> Callable[[], None]:
    """A fleet in the air; each call continues the flight."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.chdir(sys.prefix)  # MuJoCo leaves a log
    from crazyflow.control import Control  # type: ignore[import-not-found]  # prints
    from crazyflow.sim import Sim  # type: ignore[import-not-found]

    rates = dict.fromkeys(("freq", "attitude_freq", "body_rate_freq", "force_torque_freq"), RATE_HZ)
    air = Sim(n_drones=settings.agents, control=Control.state, device="cpu", **rates)
    air.reset()
    setpoints = np.zeros((1, settings.agents, 16), np.float32)  # position, velocity, acceleration, attitude x y z w, rates
    setpoints[..., :3], setpoints[..., 12] = np.asarray(air.data.states.pos), 1.0
    setpoints[..., 2] = 1.0  # from the floor
    tenths = 0

    def fly() -> None:
        nonlocal tenths
        for _ in range(round(10 * settings.span_s)):
            turn = SPEED if tenths // 10 % 2 else -SPEED
            setpoints[..., 3:5] = turn, 0.5 * turn
            setpoints[..., :2] += 0.1 * setpoints[..., 3:5]
            air.state_control(setpoints)
            air.step(RATE_HZ // 10)
            tenths += 1
        missed = np.asarray(air.data.states.pos) - setpoints[..., :3]
        assert np.all(abs(missed) < 0.5), missed  # they do fly

    return fly


if __name__ == "__main__":
    stretches(fleet)
