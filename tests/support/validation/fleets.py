"""Scenarios of a leader and its followers (those of the figures), and their true poses and errors as arrays.

Errors are computed here, independent of the metrics of the platform.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vcmvsp
from tests.support.agents.agent_loop import formation_error
from vcmvsp.cosim.reproduction.figures import scenarios
from vcmvsp.cosim.reproduction.figures.scenarios import AHEAD, ASIDE, K1, LEFT_BEHIND, RIGHT_BEHIND, UNLIMITED, R, T, V, W

__all__ = ["AHEAD", "ASIDE", "K1", "LEFT_BEHIND", "RIGHT_BEHIND", "UNLIMITED", "R", "T", "V", "W", "fleet", "lossy"]

Floats = NDArray[np.float64]
Table = Mapping[str, Any]

fleet = partial(scenarios.fleet, seed=1)


def lossy(probability: float = 0.0, delay_s: float = 0.0, jitter_s: float = 0.0) -> dict[str, Any]:
    """A radio without limits of range or bandwidth that loses and delays."""
    radio = scenarios.lossy(probability, delay_s)
    return {**radio, "delay": {**radio["delay"], "jitter_s": jitter_s}}


def poses(result: vcmvsp.Result) -> tuple[Floats, Floats]:
    """Recorded times (m,) in s and the true poses (m, vehicles, 3): x m, y m, yaw rad."""
    states = result.states.to_pandas()
    n = states.vehicle.nunique()
    yaw = 2.0 * np.arctan2(states.qz, states.qw)
    columns = np.stack([states.x, states.y, yaw], axis=-1).reshape(-1, n, 3)
    return states.time_ns.to_numpy()[::n] / 1e9, columns


def errors(result: vcmvsp.Result) -> tuple[Floats, Floats]:
    """Recorded times (m,) in s and z (m, followers, 2) in m, each in its follower's frame.

    Computed here from true poses and the last slot of each follower: not by the platform's own metrics.
    """
    times, moved = poses(result)
    follows = {placement.vehicle: placement.follows for placement in result._recorder.follows}
    followers = [f"car{number}" for number in range(2, moved.shape[1] + 1)]
    z = [formation_error(moved[:, 0], moved[:, column], follows[name]) for column, name in enumerate(followers, 1)]
    return times, np.stack(z, axis=1)
