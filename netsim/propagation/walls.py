"""Attenuation by walls on the straight line.

The bodies of vehicles in the way count as walls.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative
from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints, Paths
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT, Frequency

ITU_MATERIALS: dict[str, tuple[float, float, float, float]] = {
    "concrete": (5.24, 0.0, 0.0462, 0.7822),
    "brick": (3.91, 0.0, 0.0238, 0.16),
    "plasterboard": (2.73, 0.0, 0.0085, 0.9395),
    "wood": (1.99, 0.0, 0.0047, 1.0718),
    "glass": (6.31, 0.0, 0.0036, 1.3394),
    "metal": (1.0, 0.0, 1e7, 0.0),
}
"""ITU-R P.2040-3, table 3: relative permittivity ``a f^b`` and conductivity ``c f^d`` S/m, f in GHz (1 to 40 GHz)."""

_DARK_DB = 300.0  # finite loss that no frame survives


class Sightline(Protocol):
    """The m obstacles of the physical world, each with a material and a thickness."""

    @property
    def materials(self) -> tuple[str, ...]:
        """Material of each obstacle, (m,)."""

    @property
    def thickness_m(self) -> Floats:
        """The shortest edge of each obstacle, (m,)."""

    def crossings(self, tx: Floats, rx: Floats) -> tuple[Bools, Floats]:
        """Obstacles on the straight lines from ``tx`` (3,) to ``rx`` (n, 3), (n, m), and the lengths inside, (n, m) m.

        Equal in both directions; each receiver's row is independent of the others.
        """


class Through(NamedTuple):
    """Walls on n paths."""

    loss_db: Floats  # (n,)
    walls: Ints  # (n,) how many
    materials: tuple[str, ...]  # (n,) e.g. "2 brick, 1 wood"; "": none


class _Walls(ABC):
    """Obstacles, each with its own loss."""

    sightline: Sightline
    cap_db: float

    @property
    @abstractmethod
    def _walls_db(self) -> Floats:
        """Loss of each obstacle, (m,) dB."""

    @property
    def nothing(self) -> bool:
        """Whether there are no obstacles."""
        return not self.sightline.materials

    @cached_property
    def _by_kind(self) -> tuple[list[str], Floats]:
        """The k materials, and the material of each obstacle as a one-hot row, (m, k)."""
        kinds, index = np.unique(self.sightline.materials, return_inverse=True)
        return kinds.tolist(), np.eye(len(kinds))[index]

    @cached_property
    def _texts(self) -> dict[tuple[int, ...], str]:
        """Cache: text of numbers of obstacles, by material."""
        return {}

    def loss_db(self, paths: Paths) -> Floats:
        """Loss of each path by walls, (n,) dB."""
        return self.through(paths).loss_db

    def through(self, paths: Paths) -> Through:
        """Loss, number and materials of the walls on each path."""
        count = len(paths.distance_m)
        if self.nothing:
            return Through(np.zeros(count), np.zeros(count, np.int64), ("",) * count)
        crossed, _ = self.sightline.crossings(paths.tx, paths.rx)
        loss = np.minimum(np.where(crossed, self._walls_db, 0.0).sum(axis=-1), self.cap_db)
        kinds, of_kind = self._by_kind
        each = (crossed.astype(np.float64) @ of_kind).astype(np.int64)  # integer products are many times slower
        texts = self._texts
        rows = [tuple(row) for row in each.tolist()]
        for row in rows:
            if row not in texts:
                texts[row] = ", ".join(f"{n} {kind}" for n, kind in zip(row, kinds, strict=True) if n)
        return Through(loss, each.sum(axis=-1), tuple(map(texts.__getitem__, rows)))


@dataclass(frozen=True)
class ItuWalls(_Walls):
    """Each obstacle on the way takes the loss of a slab of its material and thickness (`slab_loss_db`), whatever the angle."""

    sightline: Sightline
    frequency_hz: Frequency = 2.4e9  # of the carrier
    cap_db: NonNegative = _DARK_DB  # maximum of all walls together: beyond it, signals arrive around the walls

    def __post_init__(self) -> None:
        for material in self.sightline.materials:
            _require_known(material)

    @cached_property
    def _walls_db(self) -> Floats:
        sizes = zip(self.sightline.materials, self.sightline.thickness_m.tolist(), strict=True)
        return np.array([min(_DARK_DB, slab_loss_db(material, size, self.frequency_hz)) for material, size in sizes])


@dataclass(frozen=True)
class FixedWalls(_Walls):
    """Each obstacle on the path has one loss, or the loss of its material in ``materials_db``.

    The default is the Wireless Simulation Server's (``eAttenFac``); it has no cap, its ``eMaxObs`` is used nowhere.
    ns-3 has wood 4, concrete 15, with windows 7, stone 12 dB (``BuildingsPropagationLossModel``), and 5 dB between rooms.
    """

    sightline: Sightline
    wall_db: NonNegative = 6.325  # loss of each obstacle
    materials_db: dict[str, NonNegative] | None = None  # by material: ``{ brick = 3.5 }``; None: all are alike
    cap_db: NonNegative = _DARK_DB  # maximum of all walls together: beyond it, signals arrive around the walls

    @cached_property
    def _walls_db(self) -> Floats:
        losses_db = self.materials_db or {}
        return np.array([losses_db.get(material, self.wall_db) for material in self.sightline.materials])


def slab_loss_db(material: str, thickness_m: float, frequency_hz: float) -> float:
    """Loss in dB of a slab of one of the `ITU_MATERIALS` at normal incidence.

    The wave is reflected repeatedly at both faces. The phases of the echoes depend on millimetres, which building maps do not
    have, so the transmitted power is averaged over all phases: it is the sum of the powers of all echoes::

        eta = a f^b - j 17.98 c f^d / f,   n = sqrt(eta)         (ITU-R P.2040-3, 3.1; f in GHz)
        R = |(n - 1) / (n + 1)|^2                                power reflected at a face
        T = |4 n / (n + 1)^2|^2                                  power that passes both faces
        A = exp(-4 pi frequency / c0 |Im n| thickness)           power left after one passage
        loss = -10 log10(T A / (1 - R^2 A^2))
    """
    _require_known(material)
    a, b, c, d = ITU_MATERIALS[material]
    gigahertz = frequency_hz * 1e-9
    index = complex(a * gigahertz**b, -17.98 * c * gigahertz**d / gigahertz) ** 0.5
    reflected = abs((index - 1.0) / (index + 1.0)) ** 2
    passage = 4.0 * math.pi * frequency_hz / SPEED_OF_LIGHT * abs(index.imag) * thickness_m  # -ln A
    both_faces = abs(4.0 * index / (index + 1.0) ** 2) ** 2
    ratio = both_faces / (1.0 - (reflected * math.exp(-passage)) ** 2)
    return 10.0 / math.log(10.0) * (passage - math.log(ratio))


def _require_known(material: str) -> None:
    if material not in ITU_MATERIALS:
        allowed = ", ".join(ITU_MATERIALS)
        raise ScenarioError(f"walls of {material!r} have no known loss; known: {allowed}; or set kind = 'fixed'", key="kind")


_NEVER_ZERO = 1e-300  # added to divisors: changes only a zero


class Bodies(NamedTuple):
    """Upright cylinders, m of them."""

    foot: Floats  # (m, 3) middle of the lower end, m, world
    radius_m: Floats  # (m,)
    height_m: Floats  # (m,)
    loss_db: Floats  # (m,) of a link that passes through


def through(bodies: Bodies, sender: int, antennas: Floats) -> tuple[Floats, Ints]:
    """Attenuation of the links of one sender by the bodies of third vehicles.

    Args:
        bodies: one for each vehicle.
        sender: its row.
        antennas: of all vehicles, (m, 3) m, world.

    Returns:
        Loss in dB and number of bodies on the straight line to each other vehicle, (m - 1,) each, in the order of the rows.
    """
    crossed = _crossed(bodies, antennas[sender], antennas)
    np.fill_diagonal(crossed, val=False)  # no vehicle blocks its own links
    crossed[:, sender] = False
    crossed = np.delete(crossed, sender, axis=0) & (bodies.loss_db > 0.0)
    return np.where(crossed, bodies.loss_db, 0.0).sum(axis=1), crossed.sum(axis=1)


def _crossed(bodies: Bodies, tx: Floats, rx: Floats) -> Bools:
    """Which lines from ``tx`` to ``rx`` (n, 3) pass through which bodies, (n, m).

    Seen from above, a body is a disc, and the line is inside it between two fractions of its length. The line passes through
    the body if it is at the body's height somewhere between. Fractions count from the middle of the line, so that both
    directions agree.
    """
    middle, run = 0.5 * (tx + rx)[:, None], (rx - tx)[:, None]
    x, y = (middle - bodies.foot)[..., 0], (middle - bodies.foot)[..., 1]
    dx, dy, dz = run[..., 0], run[..., 1], run[..., 2]
    squared = dx * dx + dy * dy + _NEVER_ZERO
    nearest = -(x * dx + y * dy) / squared
    inside = bodies.radius_m**2 - (x * dy - y * dx) ** 2 / squared  # of the disc, squared distance to its edge
    half = np.sqrt(np.maximum(inside, 0.0) / squared)
    enter, leave = np.maximum(nearest - half, -0.5), np.minimum(nearest + half, 0.5)
    ends = np.stack([middle[..., 2] + enter * dz, middle[..., 2] + leave * dz]) - bodies.foot[:, 2]
    touches = (ends.max(axis=0) > 0.0) & (ends.min(axis=0) < bodies.height_m)
    return (inside > 0.0) & (leave > enter) & touches
