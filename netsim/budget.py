"""The link budget: from transmitted power to the ratio of signal and noise at every receiver.

::

    level = power + antenna gains - path loss - walls - shadowing + fading
    SINR  = level / (noise + interference)
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.types import frozen
from netsim.bodies import Bodies, through
from netsim.error_rate import ErrorRate
from netsim.layers import Bools, Floats, Ints, Links, PathLoss, Paths, Phy, sealed
from netsim.medium import Codes, Fate
from netsim.noise import ThermalNoise
from netsim.radios import AT_POSITION, Radio

BELOW_SENSITIVITY, WALLS, SHADOWING, FADING = range(4)
"""What made a signal too weak: distance alone, or that and what else was needed."""


_SURE = 2.0**-54  # a hazard that no draw is below, but for 0


class Mean(msgspec.Struct, dict=True):
    """The mean budget of the links from one radio to n others, (n,) each."""

    row: int  # of the radio among all
    antennas: Floats  # of all, (n + 1, 3) m, world
    paths: Paths
    power_dbm: Floats  # transmitted, with both antennas
    sensitivity_dbm: Floats
    path_loss_db: Floats
    walls: Ints | None  # how many are crossed; None: there are none in the chain
    materials: tuple[str, ...] | None  # of the walls that are crossed, e.g. "2 brick, 1 wood"
    wall_loss_db: Floats | None
    shadowing_db: Floats | None
    level_dbm: Floats
    heard: dict[int, "Heard"]  # what becomes of frames of a size at this very level: filled by `Hearing`
    parts: dict[int | None, "Told"]  # by the first of the receivers that are meant: filled by `told`
    weakness: Codes | None = None  # what would make frames too weak: the same

    @cached_property
    def power_mw(self) -> Floats:
        """The level at all radios, (n + 1,) mW; 0 at itself."""
        return sealed(at_all(10.0 ** (self.level_dbm / 10.0), self.row))

    def told(self, receivers: tuple[str, ...], to: slice) -> "Told":
        """What reports of frames tell of it: of one receiver, or of all."""
        found = self.parts.get(to.start)
        if found is None:
            found = self.parts[to.start] = Told(
                receivers[to],
                frozen(self.paths.distance_m[to]),
                frozen(self.level_dbm[to]),
                frozen(self.path_loss_db[to]),
                _part(self.walls, to),
                None if self.materials is None else self.materials[to],
                _part(self.wall_loss_db, to),
                _part(self.shadowing_db, to),
            )
        return found


class Told(msgspec.Struct, frozen=True):
    """The part of a mean budget that concerns those for whom a frame is meant; fields as of `Mean`."""

    receivers: tuple[str, ...]
    distance_m: Floats
    level_dbm: Floats
    path_loss_db: Floats
    walls: Ints | None
    materials: tuple[str, ...] | None
    wall_loss_db: Floats | None
    shadowing_db: Floats | None


class Heard(msgspec.Struct, frozen=True, dict=True):
    """How a frame that nobody else disturbs reaches n receivers, (n,) each."""

    snr_db: Floats
    detected: Bools
    hazard: Floats | None  # -log(chance that it survives the noise); None: it always does

    @cached_property
    def fate(self) -> Codes:
        """Its fate, but for the packet errors of those who are in doubt."""
        return frozen(np.where(self.detected, np.uint8(Fate.RECEIVED), np.uint8(Fate.UNDETECTED)))

    @cached_property
    def doubtful(self) -> NDArray[np.intp]:
        """Who detects it and may yet lose it."""
        nobody = np.zeros(0, np.intp)
        return nobody if self.hazard is None else np.flatnonzero(self.detected & (self.hazard > _SURE))


class Budgets:
    """Mean budgets, each worked out once per sender and geometry."""

    def __init__(
        self,
        path_loss: PathLoss,
        walls: Any,
        shadowing: PathLoss | None,
        phy: Phy,
        radios: Mapping[str, Radio],
        least_dbm: float,
    ) -> None:
        self.least_dbm = least_dbm  # that is noticed, unless a vehicle's own radio says otherwise
        self._path_loss, self._walls, self._shadowing = path_loss, walls, shadowing
        self._phy, self._radios = phy, radios
        self._blocking = any(radio.body_loss_db for radio in radios.values())
        self.start()

    def start(self) -> None:
        """Forget where everybody is."""
        self._seed = 0
        self._names: tuple[str, ...] = ()
        self._position: Floats | None = None
        self._antennas = np.zeros((0, 3))
        self._raised = np.zeros((0, 3))  # antennas above their vehicles' positions, (n, 3) m
        self._fixed: dict[str, tuple[Links, Floats, Floats]] = {}  # by sender: power and sensitivity of its links
        self._means: dict[str, Mean] = {}

    def mean(self, links: Links, names: tuple[str, ...], position: Floats, *, bodies: bool = True) -> Mean:
        """The budget of the links from one sender.

        Args:
            links: from it to all others, in the order of ``names``.
            names: the vehicles.
            position: where they are, (len(names), 3) m, world; the same array object means the same places.
            bodies: whether vehicles stand in the way of others, as far as their radios say so.
        """
        if position is not self._position or names is not self._names:
            if names is not self._names:
                self._raised = np.array([(0.0, 0.0, self._of(name).antenna_height_m) for name in names])
            self._position, self._names, self._seed, self._means = position, names, links.seed, {}
            self._antennas = position + self._raised
        found = self._means.get(links.sender)
        if found is None:
            row = names.index(links.sender)
            others = np.concatenate([self._antennas[:row], self._antennas[row + 1 :]])
            paths = Paths.between(self._antennas[row], others, links.seed)
            found = self._means[links.sender] = self._work_out(links, paths, row, bodies=bodies and self._blocking)
        return found

    def _work_out(self, links: Links, paths: Paths, row: int, *, bodies: bool) -> Mean:
        fixed = self._fixed.get(links.sender)
        if fixed is None or fixed[0] is not links:
            fixed = self._fixed[links.sender] = (links, self._power_dbm(links), self.sensitivity_dbm(links.receivers))
        _, power_dbm, sensitivity_dbm = fixed
        path_loss_db = self._path_loss.loss_db(paths)
        walls = materials = wall_loss_db = shadowing_db = None
        loss_db = path_loss_db
        if self._walls is not None:
            if hasattr(self._walls, "through"):
                wall_loss_db, walls, materials = self._walls.through(paths)
            else:
                wall_loss_db = self._walls.loss_db(paths)
            loss_db = loss_db + wall_loss_db
        if bodies:
            in_way_db, others = self._bodies_in_way(row)
            wall_loss_db = in_way_db if wall_loss_db is None else wall_loss_db + in_way_db
            walls = others if walls is None else walls + others
            materials = _with_vehicles(materials or ("",) * len(others), others)
            loss_db = path_loss_db + wall_loss_db
        if self._shadowing is not None:
            shadowing_db = self._shadowing.loss_db(paths)
            loss_db = loss_db + shadowing_db
        level_dbm = power_dbm - loss_db
        return Mean(
            row,
            self._antennas,
            paths,
            power_dbm,
            sensitivity_dbm,
            frozen(path_loss_db),
            None if walls is None else frozen(walls),
            materials,
            None if wall_loss_db is None else frozen(wall_loss_db),
            None if shadowing_db is None else frozen(shadowing_db),
            sealed(level_dbm),
            {},
            {},
        )

    def _power_dbm(self, links: Links) -> Floats:
        """Transmitted, with both antennas, (n,)."""
        own_dbm = float(self.tx_power_dbm((links.sender,))[0]) + self._of(links.sender).antenna_gain_dbi
        power_dbm: Floats = own_dbm + self.gain_dbi(links.receivers)
        return power_dbm

    def here(self, links: Links) -> Mean:
        """The budget of the links from a radio, with everybody where they were last."""
        assert self._position is not None  # noqa: S101  known since `mean`
        return self.mean(links, self._names, self._position)

    def tx_power_dbm(self, names: tuple[str, ...]) -> Floats:
        """Of the radios of these vehicles, (n,)."""
        own = [self._of(name).tx_power_dbm for name in names]
        return np.array([self._phy.tx_power_dbm if each is None else each for each in own], np.float64)

    def sensitivity_dbm(self, names: tuple[str, ...]) -> Floats:
        """Of the radios of these vehicles, (n,)."""
        if not self._radios:
            return np.full(len(names), self.least_dbm)
        own = [self._of(name).sensitivity_dbm for name in names]
        return np.array([self.least_dbm if each is None else each for each in own], np.float64)

    def gain_dbi(self, names: tuple[str, ...]) -> Floats:
        """Of the antennas of these vehicles, (n,)."""
        if not self._radios:
            return np.zeros(len(names))
        return np.array([self._of(name).antenna_gain_dbi for name in names], np.float64)

    def loss_db(self, tx: Floats, rx: Floats) -> Floats:
        """Mean loss from any point (3,) to others (n, 3), (n,) dB: path loss, walls and shadowing."""
        paths = Paths.between(tx, rx, self._seed)
        return sum((layer.loss_db(paths) for layer in (self._walls, self._shadowing) if layer), self._path_loss.loss_db(paths))

    def _bodies_in_way(self, row: int) -> tuple[Floats, Ints]:
        own = [self._of(name) for name in self._names]
        sizes = (np.array([getattr(each, size) for each in own]) for size in ("body_radius_m", "body_height_m", "body_loss_db"))
        assert self._position is not None  # noqa: S101  known since `mean`
        return through(Bodies(self._position, *sizes), row, self._antennas)

    def _of(self, name: str) -> Radio:
        return self._radios.get(name, AT_POSITION)


def _with_vehicles(materials: tuple[str, ...], others: Ints) -> tuple[str, ...]:
    """What is crossed, in words, the vehicles among it."""
    words = [f"{n} vehicle" if n else "" for n in others.tolist()]
    return tuple(", ".join(filter(None, pair)) for pair in zip(materials, words, strict=True))


def _part(values: Any, to: slice) -> Any:
    return None if values is None else frozen(values[to])


def at_all(values: Floats, row: int) -> Floats:
    """Values of all but one, with a zero for that one."""
    everywhere = np.zeros(len(values) + 1)  # np.insert and np.delete take ten times as long
    everywhere[:row] = values[:row]
    everywhere[row + 1 :] = values[row:]
    return everywhere


class Hearing:
    """What receivers make of a level."""

    def __init__(self, phy: Phy, preamble_db: float) -> None:
        self.preamble_db = preamble_db  # above noise and interference, from where on a frame is noticed
        self.noise_dbm: float = getattr(phy, "noise_dbm", ThermalNoise().dbm)
        self.noise_mw = 10.0 ** (self.noise_dbm / 10.0)
        self.errors: ErrorRate | None = getattr(phy, "errors", None)

    def hear(self, mean: Mean, level_dbm: Floats, size_bytes: int) -> Heard:
        """How a frame arrives that has ``level_dbm`` (n,), where nobody else sends."""
        fixed = level_dbm is mean.level_dbm
        if fixed and size_bytes in mean.heard:
            return mean.heard[size_bytes]
        snr_db = self.over_noise(level_dbm)
        detected = (level_dbm >= mean.sensitivity_dbm) & self.noticed(snr_db)
        heard = Heard(snr_db, detected, None if self.errors is None else self.errors.frame_hazard(snr_db, size_bytes))
        if fixed:
            mean.heard[size_bytes] = heard
        return heard

    def over_noise(self, level_dbm: Floats) -> Floats:
        """Signal to noise ratio at some levels, (n,) dB."""
        return sealed(level_dbm - self.noise_dbm)

    def noticed(self, sinr_db: Floats) -> Bools:
        """Where a preamble stands out enough."""
        stands_out: Bools = sinr_db >= self.preamble_db
        return stands_out

    def weakness(self, mean: Mean) -> Codes:
        """Of a signal that is too weak, what made it so: the first of distance, walls, shadowing that did; else fading."""
        if mean.weakness is None:
            mean.weakness = self._weakness(mean)
        return mean.weakness

    def _weakness(self, mean: Mean) -> Codes:
        least = np.maximum(mean.sensitivity_dbm, self.noise_dbm + self.preamble_db)
        level = mean.power_dbm - mean.path_loss_db
        why = np.where(level >= least, np.uint8(FADING), np.uint8(BELOW_SENSITIVITY))
        for loss_db, name in ((mean.wall_loss_db, WALLS), (mean.shadowing_db, SHADOWING)):
            if loss_db is not None:
                level = level - loss_db
                why = np.where((why == FADING) & ~(level >= least), np.uint8(name), why)
        return why
