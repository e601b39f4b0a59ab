"""Tasks of multi-agent learning: what vehicles observe, what they may do, their reward, and when an episode ends.

All computations are over w worlds of n vehicles at once, so that one class serves `cosim.learning.parallel_env` (one world) and
`cosim.learning.vector_env` (many), with the same numbers. Positions are in the world frame (ENU), all units are SI.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

OWN = ("x_m", "y_m", "z_m", "cos_yaw", "sin_yaw", "vx_m_s", "vy_m_s", "vz_m_s", "yaw_rate_rad_s")
"""What each vehicle observes of itself: position and velocity in the world frame."""
SPEED_BOUND, YAW_RATE_BOUND, AGE_BOUND_S = 100.0, 100.0, 1000.0  # of observations
LEAST_DBM, MOST_DBM = -200.0, 100.0  # of received levels; the least stands for a vehicle that was never heard


@dataclass
class Worlds:
    """State of w worlds with n vehicles each, at one tick."""

    time_s: Floats  # (w,) since the start of the episode
    position: Floats  # (w, n, 3) m
    velocity: Floats  # (w, n, 3) m/s
    yaw: Floats  # (w, n) rad
    yaw_rate: Floats  # (w, n) rad/s
    message: Floats  # (w, n, n - 1, m) newest message that each vehicle has from each other one, in the order of vehicles
    age_s: Floats  # (w, n, n - 1) since it was sent; `AGE_BOUND_S`: there is none
    rssi_dbm: Floats  # (w, n, n - 1) its level at the receiver
    heard: Bools  # (w, n, n - 1) whether there is one
    memory: dict[str, Any] = field(default_factory=dict)  # of the task: arrays (w, ...), which it may change


class Task:
    """A scenario in which all vehicles learn. Derive a class, give it a scenario, a reward, and what else it needs.

    Attributes:
        name: of the task, in policy files.
        flies: commands are velocities (x, y, z) in the world frame and a yaw rate; else a forward speed and a yaw rate.
        max_speed, max_climb, max_yaw_rate: of commands, m/s, m/s and rad/s: an action of 1.
        message_floats: numbers of a message; each takes 4 bytes on the air.
        reach_m: bound of positions in observations.
        sensors: names of the vehicles' sensors whose readings are observed (in `parallel_env` only).
    """

    name: ClassVar[str] = "scenario"
    flies: bool = False
    max_speed: float = 0.75
    max_climb: float = 1.0
    max_yaw_rate: float = 1.5
    message_floats: int = 4
    reach_m: float = 100.0
    sensors: tuple[str, ...] = ()

    def scenario(self) -> Mapping[str, Any] | str | Path:
        """The scenario: a built-in name, a path, or the content of a file."""
        raise NotImplementedError

    def starts(self, rng: np.random.Generator) -> Floats | None:
        """Start poses of one episode, (n, 4): x, y, z m and heading rad; None: the scenario's."""
        return None

    def begin(self, rng: np.random.Generator, starts: Floats) -> dict[str, Any]:
        """The task's memory of one world at the start of an episode; start poses (n, 4). Draws come after those of `starts`."""
        return {}

    def features(self, worlds: Worlds) -> Floats:
        """What each vehicle observes besides its own state and messages, (w, n, k)."""
        return np.zeros((*worlds.yaw.shape, 0))

    def features_bound(self) -> float:
        """Bound of the numbers of `features`."""
        return self.reach_m

    def step(self, worlds: Worlds) -> tuple[Floats, Bools]:
        """Rewards (w, n) of the tick that ends now, and whether each world's task is done, (w,)."""
        return np.zeros(worlds.yaw.shape), np.zeros(len(worlds.yaw), np.bool_)

    def shared(self, worlds: Worlds) -> Floats:
        """What a critic may know of a world besides the true states of all vehicles, (w, k)."""
        return np.zeros((len(worlds.yaw), 0))

    def marks(self, worlds: Worlds) -> Floats:
        """Places to mark in pictures of the first world, (k, 2) m."""
        return np.zeros((0, 2))

    def baseline(self, observations: "Observed") -> Floats:
        """Actions (..., n, a) of a simple rule, for vehicles that do not learn; by default they stand still and are silent."""
        shape = observations.values.shape[:-1]
        return np.zeros((*shape, self.action_size))

    @property
    def motions(self) -> int:
        """Numbers of an action that are motion."""
        return 4 if self.flies else 2

    @property
    def action_size(self) -> int:
        """Numbers of an action: motion, whether to send, message."""
        return self.motions + 1 + self.message_floats

    def motion(self, actions: Floats) -> Floats:
        """Commands (..., 4) of actions (..., a) in [-1, 1]: m/s in x, y, z (on the ground: forward, 0, 0), and rad/s."""
        command = np.zeros((*actions.shape[:-1], 4))
        if self.flies:
            command[..., :2] = actions[..., :2] * self.max_speed
            command[..., 2] = actions[..., 2] * self.max_climb
        else:
            command[..., 0] = actions[..., 0] * self.max_speed
        command[..., 3] = actions[..., self.motions - 1] * self.max_yaw_rate
        return command


class Observed:
    """Observations (..., n, size) of n vehicles, with views of their parts.

    Attributes:
        own: (..., n, 9), see `OWN`.
        features: (..., n, k), see `Task.features`.
        message: (..., n, n - 1, m) newest message of each other vehicle.
        age_s, rssi_dbm, heard: (..., n, n - 1) of these messages; ``heard`` is 0 or 1.
        sensors: (..., n, s) readings.
    """

    def __init__(self, values: NDArray[Any], layout: "Layout") -> None:
        self.values = values
        shape, floats = values.shape[:-1], layout.message_floats
        self.own, self.features = values[..., layout.own], values[..., layout.features]
        self.sensors = values[..., layout.sensors]
        others = values[..., layout.others].reshape(*shape, layout.vehicles - 1, floats + 3)
        self.message = others[..., :floats]
        self.age_s, self.rssi_dbm, self.heard = others[..., floats], others[..., floats + 1], others[..., floats + 2]


@dataclass(frozen=True)
class Layout:
    """Places of the parts of an observation of one vehicle among n, a vector: own state, features, sensors, others."""

    vehicles: int
    message_floats: int
    feature_count: int  # numbers of `Task.features`
    reading_count: int = 0  # numbers of all sensors

    @property
    def own(self) -> slice:
        """Place of the vehicle's own state (`OWN`)."""
        return slice(0, len(OWN))

    @property
    def features(self) -> slice:
        """Place of the task's features (`Task.features`)."""
        return slice(len(OWN), len(OWN) + self.feature_count)

    @property
    def sensors(self) -> slice:
        """Place of the sensors' readings."""
        return slice(self.features.stop, self.features.stop + self.reading_count)

    @property
    def others(self) -> slice:
        """Place of the other vehicles: for each the newest message, its age in s, its level in dBm, and 1 (0: none yet)."""
        return slice(self.sensors.stop, self.size)

    @property
    def size(self) -> int:
        """Numbers of an observation."""
        return self.sensors.stop + (self.vehicles - 1) * (self.message_floats + 3)

    def bounds(self, task: Task, readings: Floats | None = None) -> NDArray[np.float32]:
        """Least and greatest observation, (2, size); bounds of the sensors (2, readings)."""
        own = [task.reach_m] * 3 + [1.0, 1.0] + [SPEED_BOUND] * 3 + [YAW_RATE_BOUND]
        greatest = np.zeros(self.size)
        greatest[self.own], greatest[self.features] = own, task.features_bound()
        least = -greatest
        floats = self.message_floats
        each = [[-1.0] * floats + [0.0, LEAST_DBM, 0.0], [1.0] * floats + [AGE_BOUND_S, MOST_DBM, 1.0]]
        least[self.others], greatest[self.others] = np.tile(each, self.vehicles - 1)
        if readings is not None:
            least[self.sensors], greatest[self.sensors] = readings
        return np.array([least, greatest], np.float32)

    def observations(self, worlds: Worlds, features: Floats, bounds: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observations (w, n, size), within their bounds; sensors stay 0."""
        w, n = worlds.yaw.shape
        values = np.zeros((w, n, self.size), np.float32)
        values[..., 0:3] = worlds.position
        values[..., 3] = np.cos(worlds.yaw)
        values[..., 4] = np.sin(worlds.yaw)
        values[..., 5:8] = worlds.velocity
        values[..., 8] = worlds.yaw_rate
        values[..., self.features] = features
        others = values[..., self.others].reshape(w, n, n - 1, self.message_floats + 3)  # a view
        others[..., :-3] = worlds.message
        others[..., -3], others[..., -2], others[..., -1] = worlds.age_s, worlds.rssi_dbm, worlds.heard
        return np.minimum(np.maximum(values, bounds[0], out=values), bounds[1], out=values)  # np.clip takes five times as long
