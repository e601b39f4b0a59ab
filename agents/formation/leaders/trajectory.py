"""A leader that drives a given path open loop and reports its pose.

"Open loop" means that the commands depend on time alone, not on the pose of the leader: noise in its pose changes what it
reports, not how it drives, and all followers of a study face the same leader.
"""

import math
from collections import deque
from typing import Any, Literal

import numpy as np

from vcmvsp.agents.formation.leaders.leader import Leader, towards
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.types import Count, Positive

Path = Literal["straight", "circle", "slalom", "stopgo", "random"]

# Yaw rate of each path where the scenario gives none, rad/s: of a circle, or the amplitude, or the largest that is drawn.
STANDARD_YAW_RATE = {"straight": 0.0, "circle": 0.15, "slalom": 0.4, "stopgo": 0.3, "random": 0.35}

REDRAW_S = 2.0  # period of new target speeds of a random path
ACCELERATION, YAW_ACCELERATION = 0.3, 0.6  # m/s2, rad/s2: limits of a random path


class Trajectory(Leader):
    """Drive a standard path; the command of each tick holds until the next.

    ============ ======================================= ==========================================
    path         v, m/s                                  w, rad/s
    ============ ======================================= ==========================================
    ``straight`` speed                                   0
    ``circle``   speed                                   yaw_rate (0.15: radius 2 m at 0.3 m/s)
    ``slalom``   speed                                   yaw_rate (0.4) sin(2 pi t / sway_s)
    ``stopgo``   speed (1 + 0.5 sin(2 pi t / surge_s))   yaw_rate (0.3) sin(2 pi t / sway_s)
    ``random``   towards speed x U(1/3, 3/2)             towards yaw_rate (0.35) x U(-1, 1)
    ============ ======================================= ==========================================

    The random path draws both targets every 2 s and moves towards them by at most 0.3 m/s2 and 0.6 rad/s2, from ``speed`` and
    0. It depends on ``path_seed`` alone, not on the seed of the run: runs that differ in radio or noise have the same path.

    Args:
        path: one of the table.
        speed: m/s; negative: in reverse (which turns followers round, see README).
        yaw_rate: rad/s; default: the standard one of the path. Not for ``straight``.
        sway_s: period of ``slalom`` and of the turning in ``stopgo``, s.
        surge_s: period of the speed in ``stopgo``, s.
        path_seed: which random path.
        leading: tell, plan_ticks, estimator, horizon_s, fade_s, sending, formation, avoidance, clock_bound_s, as of `Leader`.
    """

    def __init__(
        self,
        path: Path = "circle",
        speed: float = 0.3,
        yaw_rate: float | None = None,
        *,
        sway_s: Positive = 16.0,
        surge_s: Positive = 9.0,
        path_seed: Count = 7,
        **leading: Any,
    ) -> None:
        super().__init__(**leading)
        if path not in STANDARD_YAW_RATE:
            raise ValueError(f"path {path!r} is not one of {', '.join(STANDARD_YAW_RATE)}")
        if path == "straight" and yaw_rate:
            raise ValueError(
                f"yaw_rate = {yaw_rate}, but a straight path has no yaw rate; leave it out, or set path = 'circle'"
            )
        self.path, self.speed, self.sway_s, self.surge_s = path, speed, sway_s, surge_s
        self.yaw_rate = STANDARD_YAW_RATE[path] if yaw_rate is None else yaw_rate
        # The sequence of numpy's default_rng(path_seed); the generator is named so that a later default cannot change it.
        self._draws = np.random.Generator(np.random.PCG64(path_seed))
        self._v, self._w, self._target_v, self._target_w, self._next_draw_ns = speed, 0.0, speed, 0.0, 0
        self._coming: deque[tuple[float, float]] = deque()  # speeds of the plan that was reported
        self._ticks = Ticks.every(self.period)
        self._known_ns = 0  # speeds are computed up to this time

    def start(self, info: VehicleInfo) -> None:
        """Note the ticks to come, too."""
        super().start(info)
        self._ticks = Ticks.every(info.period_s)

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """Speeds of the path at this time."""
        if self._coming:
            return self._coming.popleft()
        self._known_ns = obs.time_ns
        return self._speeds(obs.time_ns)

    def ahead(self, count: int) -> list[tuple[float, float]]:
        """Speeds of the next ticks; a random path is drawn up to there, which does not change it."""
        while len(self._coming) < count:
            self._known_ns = self._ticks.after(self._known_ns)
            self._coming.append(self._speeds(self._known_ns))
        return list(self._coming)

    def _speeds(self, time_ns: int) -> tuple[float, float]:
        if self.path == "random":
            return self._random(time_ns)
        t = time_ns / 1e9
        sway = math.sin(math.tau * t / self.sway_s)
        if self.path == "slalom":
            return self.speed, self.yaw_rate * sway
        if self.path == "stopgo":
            return self.speed * (1.0 + 0.5 * math.sin(math.tau * t / self.surge_s)), self.yaw_rate * sway
        return self.speed, self.yaw_rate

    def _random(self, time_ns: int) -> tuple[float, float]:
        if time_ns >= self._next_draw_ns:
            self._target_v = self.speed * self._draws.uniform(1.0 / 3.0, 1.5)
            self._target_w = self.yaw_rate * self._draws.uniform(-1.0, 1.0)
            self._next_draw_ns = time_ns + round(REDRAW_S * 1e9)
        self._v = towards(self._v, self._target_v, ACCELERATION * self._period_s)
        self._w = towards(self._w, self._target_w, YAW_ACCELERATION * self._period_s)
        return self._v, self._w
