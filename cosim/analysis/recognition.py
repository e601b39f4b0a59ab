"""How far a detector is to be trusted: counts of right and wrong answers in pictures whose targets are known."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.analysis.snapshots import InSight, Snapshot
from vcmvsp.cosim.types import Sighting

NEAR = 0.5  # sides: what is recognised no further than that from a target is that target
FREE = 0.99  # a target is unoccluded from this visible part on
RINGS = ("middle third", "second third", "outer third")  # of the way from the middle of a picture to its corners
Z = 1.959964  # standard normal, two-sided 95 %


class Share(NamedTuple):
    """So many of all."""

    part: int
    of: int

    @property
    def value(self) -> float:
        """The share; NaN: of none."""
        return self.part / self.of if self.of else math.nan

    @property
    def mean(self) -> float:
        """The mean of the posterior after a flat prior: never 0 and never 1, which no map could bear."""
        return (self.part + 1) / (self.of + 2)

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, by Wilson's score (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
        if self.of == 0:
            return 0.0, 1.0
        n, share, z2 = self.of, self.value, Z * Z
        middle = (share + 0.5 * z2 / n) / (1.0 + z2 / n)
        reach = Z / (1.0 + z2 / n) * math.sqrt(share * (1.0 - share) / n + 0.25 * z2 / (n * n))
        return (middle - reach if self.part > 0 else 0.0), (middle + reach if self.part < self.of else 1.0)

    def plus(self, *answers: bool) -> "Share":
        """With further ones."""
        return Share(self.part + sum(answers), self.of + len(answers))


NONE = Share(0, 0)


@dataclass
class Rates:
    """Counts of pictures; a look is a cell of the map that a picture shows.

    Attributes:
        p: of the looks at cells with a target, those that say target.
        q: of the looks at cells without one, those that do.
        precision: of what is recognised, what is right.
        recall: of the targets in view, those that are recognised, hidden ones too.
        unoccluded: the same, of those that nothing hides.
        by_ring: the same, by where in the picture they are.
        angles: errors of those recognised, rad.
        places: m.
    """

    p: Share = NONE
    q: Share = NONE
    precision: Share = NONE
    recall: Share = NONE
    unoccluded: Share = NONE
    by_ring: dict[str, Share] = field(default_factory=lambda: dict.fromkeys(RINGS, NONE))
    angles: list[float] = field(default_factory=list)
    places: list[float] = field(default_factory=list)

    def add(self, taken: Snapshot) -> None:
        """Count a picture. A target that is not in what the detector looked at counts nowhere, unless it is recognised."""
        held = [each.cell for each in taken.targets if each.cell is not None]
        there = np.isin(taken.cells, held)
        self.p, self.q = (
            Share(old.part + int(taken.hits[cells].sum()), old.of + int(cells.sum()))
            for old, cells in ((self.p, there), (self.q, ~there))
        )
        left = list(taken.sightings)
        for target in taken.targets:
            found = next((each for each in left if _is(each, target)), None)
            if found is not None:
                left.remove(found)
                self.precision = self.precision.plus(True)
                self.angles.append(abs(math.remainder(found.angle - target.angle, math.tau)))
                self.places.append(math.dist(found.place, target.place))
            if target.looked:
                self.recall = self.recall.plus(found is not None)
            if target.looked and target.visible >= FREE:
                self.unoccluded = self.unoccluded.plus(found is not None)
                ring = _ring(target, taken)
                self.by_ring[ring] = self.by_ring[ring].plus(found is not None)
        self.precision = self.precision.plus(*(False for _ in left))

    def plain(self) -> Mapping[str, Any]:
        """Numbers by name."""
        shares = {name: getattr(self, name) for name in ("p", "q", "precision", "recall", "unoccluded")}
        told = {name: _plain(each) for name, each in shares.items()}
        for name in ("p", "q"):
            told[name]["value"] = shares[name].mean
        return {**told, "by_ring": {name: _plain(each) for name, each in self.by_ring.items()}}


def _plain(share: Share) -> dict[str, Any]:
    return {"value": share.value if share.of else None, "interval": list(share.interval), "count": share.part, "of": share.of}


def _is(one: Sighting, target: InSight) -> bool:
    return one.target == target.name and math.dist(one.place, target.place) <= NEAR * target.size_m


def _ring(target: InSight, taken: Snapshot) -> str:
    height, width = taken.pixels.shape[:2]
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    way = math.dist(target.pixel, middle) / math.hypot(*middle)
    return RINGS[min(int(3.0 * way), 2)]
