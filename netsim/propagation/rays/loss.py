"""The layers of the channel that rays give: path loss by the powers of all paths, fading by their phases."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.compiled.machine_code import Core, available
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels, NonNegative, Positive
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Frame, Ints, Paths
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT, Frequency
from vcmvsp.netsim.propagation.rays import phases
from vcmvsp.netsim.propagation.rays.arrays import Complex
from vcmvsp.netsim.propagation.rays.coefficients import MATERIALS, Echoes
from vcmvsp.netsim.propagation.rays.phases import Sums, Waves
from vcmvsp.netsim.propagation.rays.roofs import RoofPaths, over_roofs
from vcmvsp.netsim.propagation.rays.tracer import PathTable, Tracer
from vcmvsp.netsim.propagation.rays.world import RayWorld, Solids, Wave, holding, world_of

Order = Annotated[int, msgspec.Meta(ge=0, le=4)]
Limit = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]

ARRIVES = 1e-20  # power ratio: pairs with less are reached over the roofs only
_BLOCK = 1024  # pairs traced at a time
_MOST_POINTS = 512  # for more points only the links of the radio in question are computed


class LinkPaths(NamedTuple):
    """The paths of n links, m in all, link by link."""

    paths: Ints  # (n,) number of paths of each link, at least one
    power: Floats  # (n,) sum of the powers of the paths, as a ratio
    gain: Complex  # (m,)
    length_m: Floats  # (m,)
    blocks: "Sequence[Traced]" = ()  # from which it was made

    def directions(self) -> tuple[Floats, Floats]:
        """Unit vectors of all paths away from the end that comes first, and from the other one, (m, 3) each."""
        first, last = zip(*(traced.directions() for traced in self.blocks), strict=True)
        return np.concatenate(first), np.concatenate(last)

    def delays_ns(self) -> tuple[Floats, Floats]:
        """Of each link the delay of the first path, and the standard deviation of the delays by power, (n,) ns."""
        starts, to_ns = np.cumsum(self.paths) - self.paths, SECOND_NS / SPEED_OF_LIGHT
        first_m = np.minimum.reduceat(self.length_m, starts) if len(starts) else np.zeros(0)
        link = np.repeat(np.arange(len(starts)), self.paths)
        later_m, power = self.length_m - first_m[link], power_of(self.gain)
        mean_m = np.bincount(link, power * later_m, len(starts)) / self.power
        spread_m = np.sqrt(np.bincount(link, power * (later_m - mean_m[link]) ** 2, len(starts)) / self.power)
        return first_m * to_ns, spread_m * to_ns


NO_LINKS = LinkPaths(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.complex128), np.zeros(0))


class Traced(NamedTuple):
    """All m paths between some pairs of points."""

    a: Floats  # (n, 3) m
    b: Floats
    table: PathTable
    dark: Ints  # (k,) pairs that these reach with less than `ARRIVES`
    roofs: RoofPaths  # of the k

    @property
    def pair(self) -> Ints:
        """Pair of each path: of the table, then of the roofs, (m,)."""
        return np.concatenate([self.table.pair, self.dark])

    @property
    def order(self) -> Ints:
        """The paths by pair, (m,)."""
        return np.argsort(self.pair, kind="stable")

    def directions(self) -> tuple[Floats, Floats]:
        """Unit vectors of the paths by pair: away from a, and away from b, (m, 3) each."""
        table, roofs = self.table, self.roofs
        edge, rows = np.append(roofs.edge, np.zeros((1, 3)), axis=0), np.arange(len(roofs.gain))
        begin, end = np.searchsorted(roofs.edge_of, rows), np.searchsorted(roofs.edge_of, rows, side="right")
        steps = np.concatenate([table.steps, end - begin])[:, None]
        pair, last, order = self.pair, np.maximum(table.steps - 1, 0), self.order
        first_point = np.concatenate([table.point[:, 0], edge[begin]])
        last_point = np.concatenate([table.point[np.arange(len(last)), last], edge[end - 1]])
        leaving = np.where(steps > 0, first_point, self.b[pair]) - self.a[pair]
        arriving = np.where(steps > 0, last_point, self.a[pair]) - self.b[pair]
        return _units(leaving)[order], _units(arriving)[order]


def _units(vectors: Floats) -> Floats:
    """Directions of vectors, (m, 3)."""
    return np.asarray(vectors / np.maximum(np.sqrt((vectors * vectors).sum(axis=1)), 1e-9)[:, None])


@dataclass(frozen=True)
class Rays:
    """The paths of the wave among the solids of the world: reflected, diffracted, passed through walls.

    Image method; coefficients of ITU-R P.2040-3; uniform theory of diffraction (Kouyoumjian and Pathak 1974). The level is the
    sum of the powers of the paths; with ``fading = { kind = "geometric" }`` that of their waves. It takes the place of path
    loss and walls.
    """

    solids: Solids
    frequency_hz: Frequency = 2.4e9  # of the carrier
    reflections: Order = 2  # greatest number of reflections of a path
    diffraction: bool = True  # paths over one upright or level edge, also with one reflection before or behind it
    transmission: bool = True  # paths through solids thinner than slab_m
    ground: str = "concrete"  # material of the plane z = 0; none: there is no ground
    slab_m: NonNegative = 0.5  # solids thinner than this are slabs, others let nothing through
    echoes: Echoes = "phases"  # inside a slab: added with their phases, or their powers averaged over its thickness
    offset_db: Decibels = 0.0  # added to the loss of every link, as a measured log says (vcmvsp calibrate --rays)
    facet_limit: Limit = 20_000  # greatest number of facets: cylinders have up to 66 each, meshes one a triangle

    def __post_init__(self) -> None:
        if self.ground != "none" and self.ground not in MATERIALS:
            raise ScenarioError(f"must be none or one of {', '.join(MATERIALS)}, not {self.ground!r}", key="ground")
        _ = self.world  # reports what is wrong with the solids now

    @cached_property
    def world(self) -> RayWorld:
        """Facets, edges and bodies."""
        return world_of(self.solids, self.wave, self.ground, self.slab_m, self.facet_limit)

    @cached_property
    def wave(self) -> Wave:
        """The carrier."""
        return Wave(self.frequency_hz, self.echoes)

    @cached_property
    def _tracer(self) -> Tracer:
        return Tracer(self.world, self.reflections, diffraction=self.diffraction, transmission=self.transmission)

    @cached_property
    def _cache(self) -> "LinkCache":
        return LinkCache(self._links)

    def prepare(self) -> None:
        """Compile the search now, before a run in wall-clock time."""
        self._tracer.prepare()

    def loss_db(self, paths: Paths) -> Floats:
        """Loss of each link, (n,) dB, from the sum of the powers of its paths."""
        links, which = self._cache.links(paths.tx, paths.rx)
        return np.asarray(self.offset_db - 10.0 * np.log10(links.power[which]))

    def pair_loss_db(self, a: Floats, b: Floats) -> Floats:
        """Loss between points a (n, 3) m and b (n, 3) m, (n,) dB."""
        return np.asarray(self.offset_db - 10.0 * np.log10(self._links(a, b).power))

    def links(self, paths: Paths) -> tuple[LinkPaths, Ints]:
        """Links with their paths, and which of them these are, (n,); the same object until somebody has moved.

        Gains contain those of the antennas, unless all are isotropic.
        """
        links, which = self._cache.links(paths.tx, paths.rx)
        if paths.antennas is None:
            return links, which
        if self._newest.get("antennas") is not paths.antennas:
            self._newest.update(antennas=paths.antennas, seen=_between_antennas(links, which, paths))
        return self._newest["seen"], np.arange(len(which))

    def antenna_gain(self, paths: Paths) -> Floats:
        """Gain of both antennas over isotropic ones, (n,), a ratio of the sums of powers."""
        links, which = self._cache.links(paths.tx, paths.rx)
        return np.asarray(self.links(paths)[0].power / links.power[which])

    def delays_ns(self, paths: Paths) -> tuple[Floats, Floats]:
        """Travel time of the first path, and standard deviation of the travel times by power, (n,) ns."""
        links, which = self.links(paths)
        if self._newest.get("links") is not links:
            self._newest.update(links=links, delays_ns=links.delays_ns())
        first_ns, spread_ns = self._newest["delays_ns"]
        return first_ns[which], spread_ns[which]

    @cached_property
    def _newest(self) -> dict[str, Any]:
        """The links that were asked for last, and what was computed of them."""
        return {}

    def traced(self, a: Floats, b: Floats) -> Traced:
        """All paths between points a (n, 3) m and b (n, 3) m."""
        table = self._tracer.paths(a, b)
        power = np.bincount(table.pair, power_of(table.gain), len(a))
        (dark,) = np.nonzero(power < ARRIVES)
        return Traced(a, b, table, dark, over_roofs(self.world, a[dark], b[dark], self.wave.length_m))

    def _links(self, a: Floats, b: Floats) -> LinkPaths:
        """The paths of many links, each computed from the end that comes first, so that both directions are equal."""
        swapped = _comes_first(b, a)
        here, there = np.where(swapped[:, None], b, a), np.where(swapped[:, None], a, b)
        blocks = []
        for first in range(0, len(a), _BLOCK):
            found = self.traced(here[first : first + _BLOCK], there[first : first + _BLOCK])
            pair, order, count = found.pair, found.order, len(found.a)
            gain = np.concatenate([found.table.gain, found.roofs.gain])[order]
            length = np.concatenate([found.table.length_m, found.roofs.length_m])[order]
            power = np.bincount(pair[order], power_of(gain), count).astype(np.float64)
            of_link = np.bincount(pair, minlength=count).astype(np.int64)
            blocks.append(LinkPaths(of_link, power, gain, length, (found,)))
        parts = [each[:-1] for each in (NO_LINKS, *blocks)]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return LinkPaths._make([*columns, [block for each in blocks for block in each.blocks]])

    def holder(self, points: Floats) -> list[str]:
        """For each point the solid that it is inside, in words; empty: none."""
        holders = holding(self.world, points)
        words = (*self.solids.words, "") if (holders >= 0).any() else ("",)
        return [words[number] for number in holders.tolist()]


def _between_antennas(links: LinkPaths, which: Ints, paths: Paths) -> LinkPaths:
    """Some links, (n,), between the antennas of these paths."""
    count, starts = links.paths[which], np.cumsum(links.paths) - links.paths
    link = np.repeat(np.arange(len(which)), count)
    path = np.arange(len(link)) + (starts[which] - (np.cumsum(count) - count))[link]
    first, last = (each[path] for each in links.directions())
    swapped = _comes_first(paths.rx, np.broadcast_to(paths.tx, paths.rx.shape))[link, None]
    ratio = paths.antennas.gain(link, np.where(swapped, last, first), np.where(swapped, first, last))
    gain = links.gain[path] * np.sqrt(ratio)
    power = np.bincount(link, power_of(gain), len(which)).astype(np.float64)
    return LinkPaths(count, power, gain, links.length_m[path])


def power_of(gain: Complex) -> Floats:
    """Power of waves, as a ratio."""
    return np.asarray(gain.real**2 + gain.imag**2)


def _comes_first(a: Floats, b: Floats) -> np.ndarray:
    """Whether a comes before b, by x, then y, then z, (n,)."""
    apart = a != b
    column = np.argmax(apart, axis=1)
    rows = np.arange(len(a))
    return np.asarray(a[rows, column] < b[rows, column])


class LinkCache:
    """The links between radios that stand where they stood at the last question.

    The first radio that asks has its own links computed; if another one asks before anyone has moved, all of them are, and
    from then on at the first question of each instant, until only one asks.
    """

    def __init__(self, compute: Callable[[Floats, Floats], LinkPaths]) -> None:
        self._compute = compute
        self._points = b""
        self._single: tuple[int, LinkPaths] | None = None
        self._all: LinkPaths | None = None
        self._senders: set[int] = set()  # that asked since somebody moved

    def links(self, tx: Floats, rx: Floats) -> tuple[LinkPaths, Ints]:
        """Links, and which of them are those from one point (3,) m to others (n, 3) m, (n,)."""
        points = np.concatenate([tx[None], rx])
        order = np.lexsort(points.T)
        standing = points[order]
        place = np.empty(len(points), np.int64)
        place[order] = np.arange(len(points))
        key = standing.tobytes()
        if key != self._points:
            several, self._senders = len(self._senders) > 1, set()
            self._points, self._single, self._all = key, None, None
            if several and len(points) <= _MOST_POINTS:
                self._all = self._pairs(standing)
        self._senders.add(int(place[0]))
        one, other = np.minimum(place[0], place[1:]), np.maximum(place[0], place[1:])
        row = one * (2 * len(place) - one - 1) // 2 + other - one - 1  # among all pairs
        if self._all is not None:
            return self._all, row
        if self._single is None or (self._single[0] != place[0] and len(points) > _MOST_POINTS):
            others = np.delete(standing, place[0], axis=0)
            self._single = int(place[0]), self._compute(np.broadcast_to(tx, others.shape).copy(), others)
        if self._single[0] == place[0]:
            return self._single[1], place[1:] - (place[1:] > place[0])
        self._all = self._pairs(standing)
        return self._all, row

    def _pairs(self, points: Floats) -> LinkPaths:
        i, j = np.triu_indices(len(points), 1)
        return self._compute(points[i], points[j])


@dataclass(frozen=True)
class Geometric:
    """Fading that follows from where the radios are: the waves of all paths with their phases, averaged over the bandwidth.

    With gains a and lengths l of the paths, and the bandwidth B around the carrier::

        gain = sum_ik a_i conj(a_k) sinc(B (l_i - l_k) / c) / sum_i |a_i|^2

    It is the same in both directions and at every visit of a place. It needs ``path_loss = { kind = "rays" }``.
    """

    rays: Rays
    bandwidth_hz: Positive = 20e6  # of the channel: 802.11 has 20 MHz, 802.15.4 has 2 MHz

    by_place = True  # no draws: the gain depends on the places of the radios alone

    def prepare(self) -> None:
        """Compile the sums now, before a run in wall-clock time."""
        if available():
            waves, sums = _sums(NO_LINKS, self.bandwidth_hz)
            _ = Core((phases,), waves, sums).compiled

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Power gain at each receiver, (n,) dB."""
        links, which = self.rays.links(frame.paths)
        if self._newest.get("links") is not links:
            gains = np.maximum(band_power(links, self.bandwidth_hz) / links.power, _FAINTEST)
            self._newest.update(links=links, gain_db=10.0 * np.log10(gains))
        return np.asarray(self._newest["gain_db"][which])

    @cached_property
    def _newest(self) -> dict[str, Any]:
        """The links that were asked for last, and their gains."""
        return {}


_FAINTEST = 2.0**-54  # so that every gain is finite in dB
_PAIR_S, _COMPILE_S = 3e-7, 2.0  # CPU time of a pair of waves, interpreted, and for which compiling pays


def band_power(links: LinkPaths, bandwidth_hz: float) -> Floats:
    """Power of the sum of all waves of each link, averaged over a band, as a ratio, (n,)."""
    waves, sums = _sums(links, bandwidth_hz)
    Core((phases,), waves, sums).chosen(_PAIR_S * float((links.paths**2).sum()), _COMPILE_S)(waves, sums, 0)
    return sums.power


def _sums(links: LinkPaths, bandwidth_hz: float) -> tuple[Waves, Sums]:
    turn = links.length_m * (math.pi * bandwidth_hz / SPEED_OF_LIGHT)
    waves = Waves(links.paths, links.power, links.gain.real.copy(), links.gain.imag.copy(), turn, np.zeros(len(turn)))
    return waves, Sums(np.zeros(len(links.paths)))
