"""A corridor between two walls, straight or with bends."""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, Positive
from vcmvsp.physics.world.polygons import overlap_m
from vcmvsp.physics.world.solids import Prism
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings


@dataclass(frozen=True, kw_only=True)
class Corridor(Surroundings):
    """Two walls (kind ``corridor``); its middle line begins on the x axis and leads east until the first bend."""

    length: Positive = 20.0  # of its middle line, m; bends divide it into equal parts
    start: float = 0.0  # where its middle line begins, x m: robots can stand before it
    width: Positive = 2.0  # between the walls, m
    height: Positive = 2.5  # of the walls, m
    thickness: Positive = 0.2  # of the walls, m
    bends: tuple[float, ...] = ()  # rad, left is positive
    closed: bool = False  # whether the far end is walled up
    material: str = "brick"  # of the walls

    def __post_init__(self) -> None:
        super().__post_init__()
        reach = (0.5 * self.width + self.thickness) * math.tan(0.5 * max(map(abs, self.bends), default=0.0))
        if max(map(abs, self.bends), default=0.0) >= 0.99 * math.pi or 2.0 * reach >= self.part:
            problem = f"parts of {self.part:g} m are too short for such a bend: make length longer, or width or bends smaller"
            raise ScenarioError(problem, key="bends")

    @property
    def part(self) -> float:
        """Length of the middle line between two bends, m."""
        return self.length / (len(self.bends) + 1)

    def middle(self) -> Array:
        """The middle line: start, bends and end, (bends + 2, 2) m."""
        headings = np.concatenate([[0.0], np.cumsum(self.bends)])
        steps = self.part * np.column_stack([np.cos(headings), np.sin(headings)])
        return np.cumsum(np.concatenate([[[self.start, 0.0]], steps]), axis=0)

    def build(self) -> World:
        """The world itself.

        Raises:
            ScenarioError: the corridor would run into itself.
        """
        inner, outer = 0.5 * self.width, 0.5 * self.width + self.thickness
        walls = [*self._wall(inner, outer), *self._wall(-outer, -inner)]
        if self.closed:
            *_, before, end = self.middle()
            along = (end - before) / self.part * self.thickness
            across = np.array([-along[1], along[0]]) / self.thickness * outer
            walls.append(np.array([end - across, end - across + along, end + across + along, end + across]))
        if any(overlap_m(a, b) > 1e-9 for a, b in combinations(walls, 2)):
            raise ScenarioError("the corridor would run into itself: make length longer, or bends smaller", key="bends")
        solids = []
        for wall in walls:
            outline = tuple((x, y) for x, y in wall.tolist())
            solids.append(Prism(outline=outline, height=self.height, material=self.material))
        return self.complete("corridor", solids=solids)

    def _wall(self, right: float, left: float) -> list[Array]:
        """Quadrangles, one for each part, between two lines at these distances to the left of the middle line, m."""
        a, d = self._along(right), self._along(left)
        return [*np.stack([a[:-1], a[1:], d[1:], d[:-1]], axis=1)]

    def _along(self, left: float) -> Array:
        """A line at a distance to the left of the middle line, m, mitred at the bends."""
        headings = np.concatenate([[0.0], np.cumsum(self.bends)])
        before, after = np.append(headings, headings[-1]), np.concatenate([headings[:1], headings])
        half = 0.5 * (after - before)  # at each corner, what is still to turn from the one to the other
        across = 0.5 * (before + after) + 0.5 * math.pi
        line: Array = self.middle() + (left / np.cos(half))[:, None] * np.column_stack([np.cos(across), np.sin(across)])
        return line
