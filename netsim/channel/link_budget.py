"""The link budget: from transmitted power to the ratio of signal and noise at every receiver.

::

    level = power + antenna gains - path loss - walls - shadowing + fading
    SINR  = level / (noise + interference)
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.interfaces.layers import (
    AT_POSITION,
    Bools,
    Floats,
    Ints,
    PathLoss,
    Paths,
    Phy,
    Radio,
    SenderLinks,
    distances,
    sealed,
)
from vcmvsp.netsim.interfaces.medium import Codes
from vcmvsp.netsim.phy.constant_rate import ThermalNoise
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.propagation.antennas import Antennas, LinkAntennas, pattern_of
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.walls import Bodies, through

BELOW_SENSITIVITY, WALLS, SHADOWING, FADING = range(4)
"""Causes of a signal that is too weak: distance alone, or distance together with walls, shadowing or fading."""

AT_ONCE = 1 << 16  # links in a batch: NumPy's overhead for each call is negligible for more
_SURE = 2.0**-54  # hazard that every frame survives: no draw is less, except 0
_REPORTED = ("path_loss_db", "walls", "wall_loss_db", "shadowing_db", "path_delay_ns", "delay_spread_ns")
"""Columns of a `LinkBudget` that reports contain, if the channel has them."""


class ReceivedSignal(msgspec.Struct, frozen=True, dict=True):
    """Signals of k frames without interference at n receivers each, (k, n)."""

    snr_db: Floats
    detected: Bools
    hazard: Floats | None  # -log(chance that a frame survives the noise); None: it always does

    @cached_property
    def fate(self) -> Codes:
        """Fate before packet errors."""
        return sealed((~self.detected).view(np.uint8))  # `Fate.RECEIVED` is 0, `Fate.UNDETECTED` 1

    @cached_property
    def doubtful(self) -> tuple[NDArray[np.intp], ...]:
        """Frames and receivers, (m,) each, where a frame is detected and may yet be lost."""
        risky = False if self.hazard is None else self.hazard > _SURE
        return (self.detected & risky).nonzero()

    def rows(self, which: Sequence[int]) -> "ReceivedSignal":
        """The signals of some frames."""
        index = slice(which[0], which[0] + 1) if len(which) == 1 else which
        return ReceivedSignal(self.snr_db[index], self.detected[index], None if self.hazard is None else self.hazard[index])


def propagation_ns(distance_m: Floats) -> Ints:
    """Travel time over distances in free space, whole ns."""
    return np.rint(distance_m * (SECOND_NS / SPEED_OF_LIGHT)).astype(np.int64)


class LinkBudget(msgspec.Struct, dict=True):
    """Mean budgets of the links from each of k radios to the n others; k is 1 unless path loss is all there is."""

    senders: Sequence[SenderLinks]  # (k,)
    rows: NDArray[np.intp]  # (k,) of these radios among all
    others: Bools  # (k, n + 1): False at the sender itself
    antennas: Floats  # of all, (n + 1, 3) m, world
    rx: Floats  # (k, n, 3) m, world
    distance_m: Floats  # (k, n)
    power_dbm: Floats  # (k, n) transmitted, with both antennas
    sensitivity_dbm: Floats  # (k, n)
    path_loss_db: Floats  # (k, n)
    level_dbm: Floats  # (k, n)
    walls: Ints | None = None  # (k, n) number of walls crossed; None: no walls in the channel
    materials: tuple[str, ...] | None = None  # (n,) of the walls that are crossed, e.g. "2 brick, 1 wood"
    wall_loss_db: Floats | None = None  # (k, n)
    shadowing_db: Floats | None = None  # (k, n)
    path_delay_ns: Floats | None = None  # (k, n) see `PathLoss`; None: only the straight line is known
    delay_spread_ns: Floats | None = None  # (k, n)
    link_antennas: LinkAntennas | None = None  # None: all antennas are isotropic
    signals: dict[int, ReceivedSignal] = msgspec.field(default_factory=dict)  # by size: filled by `ReceiverModel`
    weakness: Codes | None = None  # (k, n) cause of a signal that is too weak: filled by `ReceiverModel`

    @cached_property
    def power_mw(self) -> Floats:
        """The levels at all radios, (k, n + 1) mW; 0 at the sender itself."""
        everywhere = np.zeros(self.others.shape)
        everywhere[self.others] = (10.0 ** (self.level_dbm / 10.0)).ravel()
        return sealed(everywhere)


class MeanBudget:
    """One row of a `LinkBudget`: the links from one radio to n others."""

    def __init__(self, every: LinkBudget, place: int) -> None:
        self.every, self.place = every, place
        self.level_dbm: Floats = every.level_dbm[place]
        self.paths = Paths(
            every.antennas[every.rows[place]],
            every.rx[place],
            every.distance_m[place],
            every.senders[place].seed,
            every.link_antennas,
        )
        self.signals: dict[int, ReceivedSignal] = {}  # (1, n), by size: filled by `ReceiverModel`
        self._columns: dict[int | None, dict[str, Any]] = {}  # by place of the first receiver

    @property
    def power_mw(self) -> Floats:
        """The level at all radios, (n + 1,) mW; 0 at itself."""
        power_mw: Floats = self.every.power_mw[self.place]
        return power_mw

    @cached_property
    def propagation_ns(self) -> Ints:
        """Travel time of the first path, (n,) whole ns."""
        delay_ns = self.every.path_delay_ns
        return propagation_ns(self.paths.distance_m) if delay_ns is None else np.rint(delay_ns[self.place]).astype(np.int64)

    def report_columns(self, to: slice) -> dict[str, Any]:
        """Fields of a `FrameReport` to one receiver, or to all, at the mean level."""
        columns = self._columns.get(to.start)
        if columns is None:
            receivers = self.every.senders[self.place].receivers[to]
            columns = {"receivers": receivers, "distance_m": self.paths.distance_m[to], "rssi_dbm": self.level_dbm[to]}
            for name in _REPORTED:
                values = getattr(self.every, name)
                if values is not None:
                    columns[name] = values[self.place][to]
            if self.every.materials is not None:
                columns["wall_materials"] = self.every.materials[to]
            self._columns[to.start] = columns
        return columns


class _Group(NamedTuple):
    """Fixed values of k radios with n receivers each."""

    rows: NDArray[np.intp]  # (k,) of these radios among all
    others: Bools  # (k, n + 1): False at the sender itself
    receivers: NDArray[np.intp]  # (k, n) rows
    power_dbm: Floats  # (k, n) transmitted, with both antennas
    sensitivity_dbm: Floats  # (k, n)


class Budgets:
    """Mean budgets, each computed once per sender and geometry; ``least_dbm``: sensitivity of radios without their own."""

    def __init__(
        self,
        path_loss: PathLoss,
        walls: PathLoss | None,
        shadowing: PathLoss | None,
        phy: Phy,
        radios: Mapping[str, Radio],
        least_dbm: float,
    ) -> None:
        self.path_loss, self._walls, self._shadowing = path_loss, walls, shadowing
        self._phy, self._radios, self.least_dbm = phy, radios, least_dbm
        self._blocking = any(radio.body_loss_db for radio in radios.values())
        self._directional = any(pattern_of(radio) is not None for radio in radios.values())
        nothing_else = walls is None and shadowing is None and not self._blocking and not self._directional
        self.by_distance: bool = nothing_else and getattr(path_loss, "by_distance", False)
        self.start()

    def start(self) -> None:
        """Forget all positions."""
        self._seed = 0
        self._names: tuple[str, ...] = ()
        self._position: Floats | None = None
        self._position_bytes = b""  # to detect movement
        self._antennas = np.zeros((0, 3))
        self._raised = np.zeros((0, 3))  # antennas above their vehicles' positions, (n, 3) m
        self._row: dict[str, int] = {}  # of each vehicle
        self._power_dbm, self._gain_dbi, self._least_dbm = np.zeros((3, 0))  # of all radios, (n,): see `_Group`
        self._groups: dict[tuple[str, ...], _Group] = {}  # of single radios, and of the last several
        self._several: tuple[str, ...] = ()  # names of the last several
        self._means: dict[str, MeanBudget] = {}
        self._moved = False  # since antennas inside solids were noted
        self.enclosed: dict[str, str] = {}  # vehicles whose antennas were inside a solid, and the first solid, in words
        self._attitude: Floats | None = None
        self._patterns: Antennas | None = None  # of all radios at this attitude

    def turn(self, attitude: Floats | None) -> None:
        """Set the attitudes of the vehicles, (n, 4), for antennas that are not isotropic; None: all are level."""
        if self._directional and attitude is not self._attitude:
            self._attitude, self._patterns, self._means = attitude, None, {}

    def mean(self, links: SenderLinks, names: tuple[str, ...], position: Floats, *, bodies: bool = True) -> MeanBudget:
        """The budget of the links from one sender.

        Args:
            links: from it to all others, in the order of ``names``.
            names: the vehicles.
            position: of the vehicles, (len(names), 3) m, world; the same array object means the same positions.
            bodies: whether bodies of vehicles attenuate, as their radios say.
        """
        before = self._move(names, position, links.seed)
        if self.by_distance and links.sender in before and 1 < len(before) <= AT_ONCE / len(names):
            self._compute([mean.every.senders[mean.place] for mean in before.values()])  # they will probably send again
        if links.sender not in self._means:
            self._compute([links], bodies=bodies and self._blocking)
        return self._means[links.sender]

    def means(self, senders: Sequence[SenderLinks], names: tuple[str, ...], position: Floats) -> list[MeanBudget]:
        """The budgets of several radios, computed in one batch; for path losses `by_distance`."""
        self._move(names, position, senders[0].seed)
        means = [self._means.get(links.sender) for links in senders]
        if len({id(mean and mean.every) for mean in means}) > 1 or means[0] is None:
            self._compute(senders)
        return [self._means[links.sender] for links in senders]

    def _move(self, names: tuple[str, ...], position: Floats, seed: int) -> dict[str, MeanBudget]:
        """Update positions; returns the budgets that became stale."""
        same = names is self._names
        if same and position is self._position:
            return {}
        stood_at, self._position_bytes = self._position_bytes, position.tobytes()
        if same and self._position_bytes == stood_at:
            self._position = position
            return {}
        before = self._means if same else {}
        if not same:
            self._groups.clear()
            self._patterns = None
            self._raised = self.antennas_above(names)
            self._row = {name: row for row, name in enumerate(names)}
            self._gain_dbi, self._least_dbm = self.gain_dbi(names), self.sensitivity_dbm(names)
            self._power_dbm = self.tx_power_dbm(names) + self._gain_dbi
        self._position, self._names, self._seed, self._means = position, names, seed, {}
        self._antennas = position + self._raised
        self._moved = True
        return before

    def note_enclosed(self) -> None:
        """Note which antennas are inside a solid since the last movement; for a path loss that knows the solids."""
        holder = getattr(self.path_loss, "holder", None)
        if self._moved and holder is not None:
            held = zip(self._names, holder(self._antennas), strict=True)
            self.enclosed.update({name: solid for name, solid in held if solid and name not in self.enclosed})
        self._moved = False

    def _compute(self, senders: Sequence[SenderLinks], *, bodies: bool = False) -> None:
        """Set the budgets of k radios; of one, unless the path loss is `by_distance`."""
        rows, others, receivers, power_dbm, sensitivity_dbm = self._group_of(senders)
        rx = self._antennas[receivers]
        if len(rows) == 1:  # twice as fast
            distance_m = sealed(distances(self._antennas[rows[0]], rx[0]))[None]
        else:
            distance_m = sealed(distances(self._antennas[rows][:, None], rx))
        obstacles: dict[str, Any] = {}
        if self.by_distance:
            path_loss: Any = self.path_loss
            path_loss_db = loss_db = sealed(path_loss.loss_db(distance_m))
        else:
            paths = Paths(self._antennas[rows[0]], rx[0], distance_m[0], senders[0].seed, self._link_antennas(rows, receivers))
            path_loss_db = frozen(self.path_loss.loss_db(paths))[None]
            loss_db, obstacles = self._obstacles(path_loss_db, paths, int(rows[0]), bodies=bodies)
            if delays := getattr(self.path_loss, "delays_ns", None):
                obstacles["path_delay_ns"], obstacles["delay_spread_ns"] = (frozen(each)[None] for each in delays(paths))
            if paths.antennas is not None:
                gain = getattr(self.path_loss, "antenna_gain", paths.antennas.straight)(paths)
                power_dbm = sealed(power_dbm + 10.0 * np.log10(gain))
                obstacles["link_antennas"] = paths.antennas
        budget = LinkBudget(
            senders=senders,
            rows=rows,
            others=others,
            antennas=self._antennas,
            rx=rx,
            distance_m=distance_m,
            power_dbm=power_dbm,
            sensitivity_dbm=sensitivity_dbm,
            path_loss_db=path_loss_db,
            level_dbm=sealed(power_dbm - loss_db),
            **obstacles,
        )
        self._means |= {links.sender: MeanBudget(budget, place) for place, links in enumerate(senders)}

    def _obstacles(self, loss_db: Floats, paths: Paths, row: int, *, bodies: bool) -> tuple[Floats, dict[str, Any]]:
        """Add walls, bodies and shadowing to the path loss, (1, n); also the fields of a `LinkBudget` that they fill."""
        path_loss_db, walls, materials, wall_loss_db = loss_db, None, None, None
        if self._walls is not None:
            if hasattr(self._walls, "through"):
                wall_loss_db, walls, materials = self._walls.through(paths)
            else:
                wall_loss_db = self._walls.loss_db(paths)
        if bodies:
            in_way_db, count = self._bodies_in_way(row)
            wall_loss_db = in_way_db if wall_loss_db is None else wall_loss_db + in_way_db
            walls = count if walls is None else walls + count
            materials = _with_vehicles(materials or ("",) * len(count), count)
        if wall_loss_db is not None:
            loss_db = path_loss_db + wall_loss_db
        shadowing_db = None if self._shadowing is None else self._shadowing.loss_db(paths)
        if shadowing_db is not None:
            loss_db = loss_db + shadowing_db
        columns = {"walls": walls, "wall_loss_db": wall_loss_db, "shadowing_db": shadowing_db}
        rows = {name: frozen(column)[None] for name, column in columns.items() if column is not None}
        return loss_db, {**rows, "materials": materials}

    def _link_antennas(self, rows: NDArray[np.intp], receivers: NDArray[np.intp]) -> LinkAntennas | None:
        """The antennas of the links of one radio, (1,), to others, (1, n); None: all are isotropic."""
        if not self._directional:
            return None
        if self._patterns is None:
            self._patterns = Antennas.of([self._of(name) for name in self._names], self._attitude)
        return LinkAntennas(self._patterns, int(rows[0]), receivers[0])

    def _group_of(self, senders: Sequence[SenderLinks]) -> "_Group":
        """What does not change while these radios and their receivers move."""
        names = tuple([links.sender for links in senders])
        group = self._groups.get(names)
        if group is None:
            rows = np.array([self._row[name] for name in names])
            others = np.arange(len(self._names)) != rows[:, None]
            receivers = np.nonzero(others)[1].reshape(len(rows), -1)
            power_dbm = self._power_dbm[rows, None] + self._gain_dbi[receivers]
            group = _Group(rows, others, receivers, power_dbm, self._least_dbm[receivers])
            if len(names) > 1:  # groups of many are large, and there may be many such groups
                self._groups.pop(self._several, None)
                self._several = names
            self._groups[names] = group
        return group

    def at_last_positions(self, links: SenderLinks) -> MeanBudget:
        """The budget of the links from a radio at the last positions."""
        assert self._position is not None  # noqa: S101  known since `mean`
        return self.mean(links, self._names, self._position)

    def tx_power_dbm(self, names: tuple[str, ...]) -> Floats:
        """Transmitted power of the radios of these vehicles, (n,)."""
        return self._own(names, "tx_power_dbm", self._phy.tx_power_dbm)

    def sensitivity_dbm(self, names: tuple[str, ...]) -> Floats:
        """Sensitivity of the radios of these vehicles, (n,)."""
        return self._own(names, "sensitivity_dbm", self.least_dbm)

    def antennas_above(self, names: tuple[str, ...]) -> Floats:
        """Places of antennas relative to their vehicles, (n, 3) m."""
        return np.array([(0.0, 0.0, self._of(name).antenna_height_m) for name in names])

    def gain_dbi(self, names: tuple[str, ...]) -> Floats:
        """Gain of the antennas of these vehicles, (n,)."""
        return self._own(names, "antenna_gain_dbi", 0.0)

    def _own(self, names: tuple[str, ...], field: str, default: float) -> Floats:
        if not self._radios:
            return np.full(len(names), float(default))
        own = np.array([getattr(self._of(name), field) for name in names], np.float64)  # None becomes NaN
        own[np.isnan(own)] = default
        return own

    def loss_db(self, tx: Floats, rx: Floats) -> Floats:
        """Mean loss from any point (3,) to others (n, 3), (n,) dB: path loss, walls and shadowing."""
        paths = Paths.between(tx, rx, self._seed)
        return sum((layer.loss_db(paths) for layer in (self._walls, self._shadowing) if layer), self.path_loss.loss_db(paths))

    def _bodies_in_way(self, row: int) -> tuple[Floats, Ints]:
        own = [self._of(name) for name in self._names]
        sizes = np.array([(each.body_radius_m, each.body_height_m, each.body_loss_db) for each in own]).T.copy()
        assert self._position is not None  # noqa: S101  known since `mean`
        return through(Bodies(self._position, *sizes), row, self._antennas)

    def _of(self, name: str) -> Radio:
        return self._radios.get(name, AT_POSITION)


def _with_vehicles(materials: tuple[str, ...], count: Ints) -> tuple[str, ...]:
    words = []
    for material, n in zip(materials, count.tolist(), strict=True):
        vehicles = f"{n} vehicle" if n else ""
        words.append(", ".join(filter(None, (material, vehicles))))
    return tuple(words)


class ReceiverModel:
    """Reception without interference; ``preamble_db``: detection threshold above noise and interference."""

    def __init__(self, phy: Phy, preamble_db: float) -> None:
        self.preamble_db = preamble_db
        self.noise_dbm: float = getattr(phy, "noise_dbm", ThermalNoise().dbm)
        self.noise_mw = 10.0 ** (self.noise_dbm / 10.0)
        self.errors: ErrorRate | None = getattr(phy, "errors", None)

    def signals(self, means: Sequence[MeanBudget], levels_dbm: Sequence[Floats], sizes: Sequence[int]) -> ReceivedSignal:
        """Signals of k frames, (k, n), at levels (n,) each."""
        every, size, varied = means[0].every, sizes[0], levels_dbm[0] is not means[0].level_dbm
        if len(means) == 1 and not varied:
            if size not in means[0].signals:
                signals = self._signals_of(every, size)
                means[0].signals[size] = signals if len(every.rows) == 1 else signals.rows([means[0].place])
            return means[0].signals[size]
        if len(means) == 1:
            return self.signal(levels_dbm[0][None], every.sensitivity_dbm[means[0].place][None], size)
        if self.errors is None or sizes.count(size) == len(sizes):
            places = [mean.place for mean in means]
            signals = self._signals_of(every, size)
            return signals if places == list(range(len(every.rows))) else signals.rows(places)
        rows = [self.signals([mean], [level], [each]) for mean, level, each in zip(means, levels_dbm, sizes, strict=True)]
        columns: Any = zip(*((row.snr_db, row.detected, row.hazard) for row in rows), strict=True)
        return ReceivedSignal(*map(np.concatenate, columns))

    def _signals_of(self, every: LinkBudget, size_bytes: int) -> ReceivedSignal:
        if size_bytes not in every.signals:
            every.signals[size_bytes] = self.signal(every.level_dbm, every.sensitivity_dbm, size_bytes)
        return every.signals[size_bytes]

    def signal(self, level_dbm: Floats, sensitivity_dbm: Floats, size_bytes: int) -> ReceivedSignal:
        """Signals at any levels, of their shape."""
        snr_db = self.over_noise(level_dbm)
        detected = (level_dbm >= sensitivity_dbm) & self.noticed(snr_db)
        return ReceivedSignal(snr_db, detected, None if self.errors is None else self.errors.frame_hazard(snr_db, size_bytes))

    def over_noise(self, level_dbm: Floats) -> Floats:
        """Signal to noise ratio at some levels, (n,) dB."""
        return sealed(level_dbm - self.noise_dbm)

    def noticed(self, sinr_db: Floats) -> Bools:
        """Where a preamble exceeds the detection threshold."""
        stands_out: Bools = sinr_db >= self.preamble_db
        return stands_out

    def weaknesses(self, means: Sequence[MeanBudget]) -> Codes:
        """Causes of too weak signals, (k, n): the first of distance, walls, shadowing that suffices; else fading."""
        every = means[0].every
        if all(mean.every is every for mean in means):
            return self._weaknesses_of(every)[[mean.place for mean in means]]
        return np.stack([self._weaknesses_of(mean.every)[mean.place] for mean in means])

    def _weaknesses_of(self, every: LinkBudget) -> Codes:
        if every.weakness is None:
            least_dbm = np.maximum(every.sensitivity_dbm, self.noise_dbm + self.preamble_db)
            level_dbm = every.power_dbm - every.path_loss_db
            why: Codes = np.where(level_dbm >= least_dbm, np.uint8(FADING), np.uint8(BELOW_SENSITIVITY))
            for loss_db, name in ((every.wall_loss_db, WALLS), (every.shadowing_db, SHADOWING)):
                if loss_db is not None:
                    level_dbm = level_dbm - loss_db
                    why = np.where((why == FADING) & ~(level_dbm >= least_dbm), np.uint8(name), why)
            every.weakness = why
        return every.weakness
