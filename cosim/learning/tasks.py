"""The built-in tasks: keep a formation, search an area, pass gates one by one."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vcmvsp.cosim.learning.task import Bools, Floats, Observed, Task, Worlds

PERIOD_S = 0.1
LOSSY: Mapping[str, Any] = {
    "loss": {"kind": "bernoulli", "probability": 0.3},
    "delay": {"kind": "fixed", "seconds": 0.2, "jitter_s": 0.02},
}
"""Radio of the built-in tasks: 30 % of all messages are lost, the others arrive two or three ticks late."""


class _Team(Task):
    """A number of vehicles of one kind, with the radio `LOSSY`."""

    duration_s: ClassVar[float]
    vehicles: int
    kind: str

    def scenario(self) -> Mapping[str, Any]:
        """The scenario."""
        places = [[0.0, 2.0 * number, 0.0] for number in range(self.vehicles)]
        return {
            "name": self.name,
            "duration_s": self.duration_s,
            "physics": {"kind": "kinematic"},
            "radio": LOSSY,
            "agents": {"period_s": PERIOD_S},
            "vehicle": [{"name": f"v{n}", "kind": self.kind, "position": place} for n, place in enumerate(places)],
        }


@dataclass
class Formation(_Team):
    """Keep slots around a point that moves on a circle, which only the first vehicle sees; the others learn of it by radio.

    Each vehicle observes its own slot relative to the point, and the first one the point itself. The reward of a vehicle is the
    negative distance to its place, m, cut at 10 m.
    """

    name: ClassVar[str] = "formation"
    duration_s: ClassVar[float] = 20.0
    vehicles: int = 3
    kind: str = "inertial"
    flies: bool = False  # the kind, 2 m above the ground
    max_speed: float = 0.75
    spacing_m: float = 1.5  # between neighbouring slots
    reach_m: float = 20.0

    def starts(self, rng: np.random.Generator) -> Floats:
        """Around the point's start, with headings at random, (n, 4)."""
        poses = np.zeros((self.vehicles, 4))
        poses[:, :2] = self._slots() + rng.uniform(-0.5, 0.5, (self.vehicles, 2))
        poses[:, 2] = 2.0 * self.flies
        poses[:, 3] = rng.uniform(-math.pi, math.pi, self.vehicles)
        return poses

    def begin(self, rng: np.random.Generator, starts: Floats) -> dict[str, Any]:
        """The circle: radius m, rate rad/s, phase rad."""
        radius_m = rng.uniform(2.0, 4.0)
        rate = rng.uniform(0.3, 0.5) / radius_m * rng.choice([-1.0, 1.0])
        return {"circle": np.array([radius_m, rate, rng.uniform(-math.pi, math.pi)])}

    def point(self, worlds: Worlds) -> tuple[Floats, Floats]:
        """Position (w, 2) m and velocity (w, 2) m/s of the point; it starts at the origin."""
        radius_m, rate, phase = worlds.memory["circle"].T
        angle = phase + rate * worlds.time_s
        position = np.stack([np.cos(angle) - np.cos(phase), np.sin(angle) - np.sin(phase)], axis=-1) * radius_m[:, None]
        velocity = np.stack([-np.sin(angle), np.cos(angle)], axis=-1) * (radius_m * rate)[:, None]
        return position, velocity

    def features(self, worlds: Worlds) -> Floats:
        """The own slot (2) and, of the first vehicle, position and velocity of the point (4), (w, n, 6)."""
        features = np.zeros((*worlds.yaw.shape, 6))
        features[..., :2] = self._slots()
        position, velocity = self.point(worlds)
        features[:, 0, 2:4], features[:, 0, 4:6] = position, velocity
        return features

    def step(self, worlds: Worlds) -> tuple[Floats, Bools]:
        """The negative error of each vehicle; an episode never ends early."""
        place = self.point(worlds)[0][:, None] + self._slots()
        error_m = np.hypot(worlds.position[..., 0] - place[..., 0], worlds.position[..., 1] - place[..., 1])
        return -np.minimum(error_m, 10.0), np.zeros(len(worlds.yaw), np.bool_)

    def shared(self, worlds: Worlds) -> Floats:
        """Position and velocity of the point, (w, 4)."""
        return np.concatenate(self.point(worlds), axis=-1)

    def marks(self, worlds: Worlds) -> Floats:
        """The places that vehicles ought to have, (n, 2) m."""
        return self.point(worlds)[0][0] + self._slots()

    def baseline(self, observations: Observed) -> Floats:
        """The first vehicle sends the point, the others extrapolate it by the age of the message; all drive to their places."""
        shape = observations.own.shape[:-1]
        leader = np.arange(shape[-1]) == 0
        target, message = observations.features[..., 2:6], observations.message[..., 0, :]
        heard = message[..., :2] * self.reach_m + message[..., 2:4] * observations.age_s[..., :1]
        point = np.where(leader[:, None], target[..., :2], heard)
        velocity = np.where(leader[:, None], target[..., 2:4], message[..., 2:4])
        is_informed = leader | (observations.heard[..., 0] > 0)
        way = point + observations.features[..., :2] - observations.own[..., :2] + velocity  # a second ahead
        actions = np.zeros((*shape, self.action_size))
        if self.flies:
            actions[..., :2] = way / self.max_speed
        else:
            turn = np.arctan2(way[..., 1], way[..., 0]) - np.arctan2(observations.own[..., 4], observations.own[..., 3])
            turn = np.arctan2(np.sin(turn), np.cos(turn))
            actions[..., 0] = np.hypot(way[..., 0], way[..., 1]) * np.cos(turn) / self.max_speed
            actions[..., 1] = 2.0 * turn / self.max_yaw_rate
        actions[~is_informed, : self.motions] = 0.0
        send = self.motions
        actions[..., send] = np.where(leader, 1.0, -1.0)
        actions[..., send + 1 : send + 3] = target[..., :2] / self.reach_m
        actions[..., send + 3 : send + 5] = target[..., 2:4]
        return np.clip(actions, -1.0, 1.0)

    def _slots(self) -> Floats:
        """Slots of all vehicles relative to the point, (n, 2) m: a line across."""
        offset = self.spacing_m * (np.arange(self.vehicles) - 0.5 * (self.vehicles - 1))
        return np.stack([np.zeros(self.vehicles), offset], axis=-1)


CELLS = 8
"""Cells of the searched area along each side."""


@dataclass
class Search(_Team):
    """Fly over all cells of a square; what others have seen is known from their messages only.

    A vehicle observes which of the cells it has seen itself. Each cell that no vehicle has seen before gives every vehicle the
    reward 1 / 64; the task is done when all are seen.
    """

    name: ClassVar[str] = "search"
    duration_s: ClassVar[float] = 40.0
    vehicles: int = 3
    kind: str = "point"
    flies: bool = True
    side_m: float = 32.0  # of the square, whose middle is the origin
    height_m: float = 5.0
    max_speed: float = 4.0
    max_climb: float = 1.0
    reach_m: float = 50.0
    message_floats: int = 4

    def starts(self, rng: np.random.Generator) -> Floats:
        """Over different cells, (n, 4); 64 vehicles at most."""
        poses = np.zeros((self.vehicles, 4))
        cells = self._cells()[rng.choice(CELLS * CELLS, self.vehicles, replace=False)]
        poses[:, :2] = cells + rng.uniform(-0.25, 0.25, (self.vehicles, 2)) * self.side_m / CELLS
        poses[:, 2] = self.height_m
        return poses

    def begin(self, rng: np.random.Generator, starts: Floats) -> dict[str, Any]:
        """The cells that each vehicle has seen, (n, 64), and those that any vehicle had seen at the last tick, (64,)."""
        return {"seen": np.zeros((self.vehicles, CELLS * CELLS), np.bool_), "found": np.zeros(CELLS * CELLS, np.bool_)}

    def features(self, worlds: Worlds) -> Floats:
        """1 for each cell that the vehicle has seen, else 0, (w, n, 64): row by row from the south-west corner."""
        seen: Floats = worlds.memory["seen"].astype(float)
        return seen

    def step(self, worlds: Worlds) -> tuple[Floats, Bools]:
        """The share of cells that are newly seen, for every vehicle; done if all are seen."""
        cell = np.floor((worlds.position[..., :2] / self.side_m + 0.5) * CELLS).astype(int)
        inside = ((cell >= 0) & (cell < CELLS)).all(axis=-1)
        w, n = np.nonzero(inside)
        worlds.memory["seen"][w, n, cell[w, n, 1] * CELLS + cell[w, n, 0]] = True
        seen = worlds.memory["seen"].any(axis=1)
        new = seen & ~worlds.memory["found"]
        worlds.memory["found"] = seen
        reward = new.sum(axis=-1) / (CELLS * CELLS)
        return np.broadcast_to(reward[:, None], inside.shape).copy(), seen.all(axis=-1)

    def shared(self, worlds: Worlds) -> Floats:
        """1 for each cell that any vehicle has seen, (w, 64)."""
        seen: Floats = worlds.memory["found"].astype(float)
        return seen

    def marks(self, worlds: Worlds) -> Floats:
        """Cells that no vehicle has seen, (k, 2) m."""
        return self._cells()[~worlds.memory["found"][0]]

    def baseline(self, observations: Observed) -> Floats:
        """Each vehicle flies to the nearest cell that it has not seen and that no other one was last heard to fly to."""
        shape = observations.own.shape[:-1]
        cells = self._cells()
        way = cells - observations.own[..., None, :2]  # (..., n, 64, 2)
        cost = np.hypot(way[..., 0], way[..., 1]) + 1e3 * observations.features
        aims = observations.message[..., 2:4] * self.reach_m  # (..., n, n - 1, 2)
        near = np.hypot(*np.moveaxis(cells - aims[..., None, :], -1, 0)) < 0.5 * self.side_m / CELLS  # (..., n, n - 1, 64)
        cost += 100.0 * (near & (observations.heard[..., None] > 0)).any(axis=-2)
        aim = np.argmin(cost, axis=-1)
        target = np.take_along_axis(way, aim[..., None, None], axis=-2)[..., 0, :]
        actions = np.zeros((*shape, self.action_size))
        actions[..., :2] = target / np.maximum(np.hypot(target[..., 0], target[..., 1]), self.max_speed * PERIOD_S)[..., None]
        actions[..., 2] = self.height_m - observations.own[..., 2]
        actions[..., 4] = 1.0
        actions[..., 5:7], actions[..., 7:9] = observations.own[..., :2] / self.reach_m, cells[aim] / self.reach_m
        return np.clip(actions, -1.0, 1.0)

    def _cells(self) -> Floats:
        """Centres of the cells, (64, 2) m, row by row from the south-west corner."""
        centre = (np.arange(CELLS) + 0.5) * self.side_m / CELLS - 0.5 * self.side_m
        return np.stack(np.meshgrid(centre, centre), axis=-1).reshape(-1, 2)


@dataclass
class Gates(_Team):
    """Pass three gates in order, without coming nearer than 1 m to another vehicle, whose place is known by radio only.

    Each vehicle observes the way to its next gate and the one after it. The reward is the progress, m, towards the next gate,
    10 for each gate passed, and -1 for each tick nearer than 1 m to another one; the task is done when all have passed all.
    """

    name: ClassVar[str] = "gates"
    duration_s: ClassVar[float] = 30.0
    vehicles: int = 3
    kind: str = "point"
    flies: bool = True
    apart_m: float = 12.0  # from gate to gate
    radius_m: float = 1.5  # of a gate
    gates: int = 3
    max_speed: float = 3.0
    max_climb: float = 2.0
    reach_m: float = 60.0

    def starts(self, rng: np.random.Generator) -> Floats:
        """In a line across, 2 m apart, (n, 4)."""
        poses = np.zeros((self.vehicles, 4))
        poses[:, 1] = 2.0 * (np.arange(self.vehicles) - 0.5 * (self.vehicles - 1))
        poses[:, 2] = 4.0 + rng.uniform(-0.5, 0.5, self.vehicles)
        return poses

    def begin(self, rng: np.random.Generator, starts: Floats) -> dict[str, Any]:
        """Centres of the gates (g, 3) m, how many each vehicle has passed, and its distance from the next one, m."""
        centres = np.zeros((self.gates, 3))
        centres[:, 0] = self.apart_m * np.arange(1, self.gates + 1)
        centres[:, 1:] = rng.uniform(-1.0, 1.0, (self.gates, 2)) * (4.0, 1.5)
        centres[:, 2] += 4.0
        distance_m = np.sqrt(((centres[0] - starts[:, :3]) ** 2).sum(axis=-1))
        return {"centres": centres, "passed": np.zeros(self.vehicles, int), "distance_m": distance_m}

    def features(self, worlds: Worlds) -> Floats:
        """The ways to the next gate and the one after it, m, and the share of gates passed, (w, n, 7)."""
        passed = worlds.memory["passed"]
        return np.concatenate(
            [
                self._way(worlds, passed),
                self._way(worlds, np.minimum(passed + 1, self.gates - 1)),
                passed[..., None] / self.gates,
            ],
            axis=-1,
        )

    def step(self, worlds: Worlds) -> tuple[Floats, Bools]:
        """Progress, gates passed, and near misses; done if all have passed all gates."""
        memory = worlds.memory
        passed, before_m = memory["passed"], memory["distance_m"]
        distance_m = np.sqrt((self._way(worlds, passed) ** 2).sum(axis=-1))
        racing = passed < self.gates
        through = racing & (distance_m < self.radius_m)
        reward = np.where(racing, before_m - distance_m, 0.0) + 10.0 * through
        apart = worlds.position[:, :, None] - worlds.position[:, None]
        near = np.sqrt((apart**2).sum(axis=-1)) < 1.0
        reward -= near.sum(axis=-1) > 1  # each vehicle is near itself
        memory["passed"] = passed = passed + through
        memory["distance_m"] = np.sqrt((self._way(worlds, passed) ** 2).sum(axis=-1))
        return reward, (passed >= self.gates).all(axis=-1)

    def shared(self, worlds: Worlds) -> Floats:
        """Centres of the gates and how many each vehicle has passed, (w, 3 g + n)."""
        centres = worlds.memory["centres"]
        return np.concatenate([centres.reshape(len(centres), -1), worlds.memory["passed"]], axis=-1)

    def marks(self, worlds: Worlds) -> Floats:
        """Centres of the gates, (g, 2) m."""
        centres: Floats = worlds.memory["centres"][0, :, :2]
        return centres

    def baseline(self, observations: Observed) -> Floats:
        """Fly to the next gate, in a line behind those that were heard nearer to it or about as near and come first by name."""
        way = observations.features[..., :3]
        gate = observations.own[..., :3] + way
        others = observations.message[..., :3] * self.reach_m
        others_distance_m = np.sqrt(((gate[..., None, :] - others) ** 2).sum(axis=-1))
        distance_m = np.sqrt((way**2).sum(axis=-1))
        before = np.tri(self.vehicles, self.vehicles - 1, -1, dtype=bool)  # of the others, those before each vehicle
        nearer = others_distance_m < distance_m[..., None] + np.where(before, 4.0, -4.0)
        rank = ((observations.heard > 0) & nearer).sum(axis=-1)
        way = way - np.stack([3.0 * rank, np.zeros_like(distance_m), np.zeros_like(distance_m)], axis=-1)
        far_m = np.sqrt((way**2).sum(axis=-1))
        finished = observations.features[..., 6] >= 1.0
        way = np.where(finished[..., None], (3.0, 0.0, 0.0), way)  # fly on, out of the way
        actions = np.zeros((*distance_m.shape, self.action_size))
        actions[..., :3] = way / np.maximum(far_m, 1.0)[..., None]
        actions[..., 4] = 1.0
        actions[..., 5:8] = observations.own[..., :3] / self.reach_m
        return np.clip(actions, -1.0, 1.0)

    def _way(self, worlds: Worlds, numbers: Any) -> Floats:
        """Ways from the vehicles to the gates of these numbers (w, n), or to the last, (w, n, 3) m."""
        numbers = np.minimum(numbers, self.gates - 1)
        way: Floats = np.take_along_axis(worlds.memory["centres"], numbers[..., None], axis=1) - worlds.position
        return way


TASKS: Mapping[str, type[Task]] = {task.name: task for task in (Formation, Search, Gates)}
"""Built-in tasks by name."""
