"""The link budget: from transmitted power to the ratio of signal and noise at every receiver.

::

    level = power + antenna gains - path loss - walls - shadowing + fading
    SINR  = level / (noise + interference)
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.channel.mean_budget import BatchBudget, MeanBudget, ReceivedSignal
from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints, PathLoss, Paths, Phy, SenderLinks, distances, sealed
from vcmvsp.netsim.interfaces.medium import Codes
from vcmvsp.netsim.interfaces.radio import AT_POSITION, Radio
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.phy.noise import ThermalNoise
from vcmvsp.netsim.propagation.body_shadowing import Bodies, through

BELOW_SENSITIVITY, WALLS, SHADOWING, FADING = range(4)
"""What made a signal too weak: distance alone, or that and what else was needed."""

AT_ONCE = 1 << 16  # links: for more, what one call of NumPy costs does not count


class Budgets:
    """Mean budgets, each worked out once per sender and geometry."""

    def __init__(
        self,
        path_loss: PathLoss,
        walls: PathLoss | None,
        shadowing: PathLoss | None,
        phy: Phy,
        radios: Mapping[str, Radio],
        least_dbm: float,
    ) -> None:
        self.least_dbm = least_dbm  # that is noticed, unless a vehicle's own radio says otherwise
        self.path_loss, self._walls, self._shadowing = path_loss, walls, shadowing
        self._phy, self._radios = phy, radios
        self._blocking = any(radio.body_loss_db for radio in radios.values())
        nothing_else = walls is None and shadowing is None and not self._blocking
        self.by_distance: bool = nothing_else and getattr(path_loss, "by_distance", False)  # of two antennas
        self.start()

    def start(self) -> None:
        """Forget where everybody is."""
        self._seed = 0
        self._names: tuple[str, ...] = ()
        self._position: Floats | None = None
        self._stand_at = b""  # the same, to see whether anybody has moved since
        self._antennas = np.zeros((0, 3))
        self._raised = np.zeros((0, 3))  # antennas above their vehicles' positions, (n, 3) m
        self._fixed: dict[str, tuple[SenderLinks, Floats, Floats]] = {}  # by sender: power and sensitivity of its links
        self._means: dict[str, MeanBudget] = {}

    def mean(self, links: SenderLinks, names: tuple[str, ...], position: Floats, *, bodies: bool = True) -> MeanBudget:
        """The budget of the links from one sender.

        Args:
            links: from it to all others, in the order of ``names``.
            names: the vehicles.
            position: where they are, (len(names), 3) m, world; the same array object means the same places.
            bodies: whether vehicles stand in the way of others, as far as their radios say so.
        """
        before = self._move(names, position, links.seed)
        if self.by_distance and links.sender in before and 1 < len(before) <= AT_ONCE / len(names):
            self._compute_batch([self._fixed[sender][0] for sender in before])  # they will probably send again
        mean = self._means.get(links.sender)
        if mean is None:
            row = names.index(links.sender)
            others = np.concatenate([self._antennas[:row], self._antennas[row + 1 :]])
            paths = Paths.between(self._antennas[row], others, links.seed)
            mean = self._means[links.sender] = self._compute(links, paths, row, bodies=bodies and self._blocking)
        return mean

    def means(self, senders: Sequence[SenderLinks], names: tuple[str, ...], position: Floats) -> list[MeanBudget]:
        """The budgets of several radios, computed in one batch; for path losses `by_distance`."""
        self._move(names, position, senders[0].seed)
        means = [self._means.get(links.sender) for links in senders]
        batches = {id(mean.together[0]) if mean is not None and mean.together is not None else None for mean in means}
        if None in batches or len(batches) > 1:
            self._compute_batch(list(senders))
        return [self._means[links.sender] for links in senders]

    def _move(self, names: tuple[str, ...], position: Floats, seed: int) -> dict[str, MeanBudget]:
        """Have everybody there; what was known of those who sent while they were elsewhere."""
        same = names is self._names
        if same and position is self._position:
            return {}
        stood_at, self._stand_at = self._stand_at, position.tobytes()
        if same and self._stand_at == stood_at:
            self._position = position
            return {}
        before = self._means if same else {}
        if not same:
            self._raised = np.array([(0.0, 0.0, self._of(name).antenna_height_m) for name in names])
        self._position, self._names, self._seed, self._means = position, names, seed, {}
        self._antennas = position + self._raised
        return before

    def _compute_batch(self, senders: list[SenderLinks]) -> None:
        power_dbm, sensitivity_dbm = (np.stack(each) for each in zip(*map(self._fixed_of, senders), strict=True))
        rows = np.array([self._names.index(links.sender) for links in senders])
        apart = np.arange(len(self._names)) != rows[:, None]
        tx = self._antennas[rows]
        rx = np.broadcast_to(self._antennas, (len(rows), *self._antennas.shape))[apart].reshape(len(rows), -1, 3)
        distance_m = sealed(distances(tx[:, None], rx))
        path_loss: Any = self.path_loss
        path_loss_db = sealed(path_loss.loss_db(distance_m))
        batch = BatchBudget(
            senders=senders,
            rows=rows,
            apart=apart,
            antennas=self._antennas,
            tx=tx,
            rx=rx,
            distance_m=distance_m,
            power_dbm=power_dbm,
            sensitivity_dbm=sensitivity_dbm,
            path_loss_db=path_loss_db,
            level_dbm=sealed(power_dbm - path_loss_db),
        )
        self._means |= {links.sender: mean for links, mean in zip(senders, batch.means(), strict=True)}

    def _compute(self, links: SenderLinks, paths: Paths, row: int, *, bodies: bool) -> MeanBudget:
        power_dbm, sensitivity_dbm = self._fixed_of(links)
        path_loss_db = self.path_loss.loss_db(paths)
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
        return MeanBudget(
            row=row,
            antennas=self._antennas,
            paths=paths,
            power_dbm=power_dbm,
            sensitivity_dbm=sensitivity_dbm,
            path_loss_db=frozen(path_loss_db),
            walls=None if walls is None else frozen(walls),
            materials=materials,
            wall_loss_db=None if wall_loss_db is None else frozen(wall_loss_db),
            shadowing_db=None if shadowing_db is None else frozen(shadowing_db),
            level_dbm=sealed(level_dbm),
        )

    def _fixed_of(self, links: SenderLinks) -> tuple[Floats, Floats]:
        """Power and sensitivity of the links of a sender, (n,) dBm each."""
        fixed = self._fixed.get(links.sender)
        if fixed is None or fixed[0] is not links:
            fixed = self._fixed[links.sender] = (links, self._power_dbm(links), self.sensitivity_dbm(links.receivers))
        return fixed[1:]

    def _power_dbm(self, links: SenderLinks) -> Floats:
        """Transmitted, with both antennas, (n,)."""
        own_dbm = float(self.tx_power_dbm((links.sender,))[0]) + self._of(links.sender).antenna_gain_dbi
        power_dbm: Floats = own_dbm + self.gain_dbi(links.receivers)
        return power_dbm

    def here(self, links: SenderLinks) -> MeanBudget:
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
        return sum((layer.loss_db(paths) for layer in (self._walls, self._shadowing) if layer), self.path_loss.loss_db(paths))

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


def _by_distance(level: Floats, least: Floats) -> Codes:
    why: Codes = np.where(level >= least, np.uint8(FADING), np.uint8(BELOW_SENSITIVITY))
    return why


class ReceiverModel:
    """What receivers make of a level."""

    def __init__(self, phy: Phy, preamble_db: float) -> None:
        self.preamble_db = preamble_db  # above noise and interference, from where on a frame is noticed
        self.noise_dbm: float = getattr(phy, "noise_dbm", ThermalNoise().dbm)
        self.noise_mw = 10.0 ** (self.noise_dbm / 10.0)
        self.errors: ErrorRate | None = getattr(phy, "errors", None)

    def hear(self, mean: MeanBudget, level_dbm: Floats, size_bytes: int) -> ReceivedSignal:
        """How a frame arrives that has ``level_dbm`` (n,), where nobody else sends."""
        if level_dbm is not mean.level_dbm:
            return self._hear(level_dbm, mean.sensitivity_dbm, size_bytes)
        if size_bytes not in mean.heard:
            if mean.together is None:
                mean.heard[size_bytes] = self._hear(level_dbm, mean.sensitivity_dbm, size_bytes)
            else:
                every, which = mean.together
                mean.heard[size_bytes] = self._hear_every(every, size_bytes).rows(which)
        return mean.heard[size_bytes]

    def hear_batch(self, means: Sequence[MeanBudget], sizes: Sequence[int]) -> ReceivedSignal:
        """Signals of k frames at their mean levels, (k, n); the budgets are from `Budgets.means`."""
        if self.errors is not None and any(size != sizes[0] for size in sizes):
            rows = [self.hear(mean, mean.level_dbm, size) for mean, size in zip(means, sizes, strict=True)]
            columns = [np.stack([getattr(row, name) for row in rows]) for name in ("snr_db", "detected", "hazard")]
            return ReceivedSignal(*columns)
        every, which = means[0].together, [mean.together[1] for mean in means if mean.together is not None]
        assert every is not None  # noqa: S101  by `Budgets.means`
        signal = self._hear_every(every[0], sizes[0])
        return signal if which == list(range(len(every[0].senders))) else signal.rows(which)

    def _hear_every(self, every: BatchBudget, size_bytes: int) -> ReceivedSignal:
        if size_bytes not in every.heard:
            every.heard[size_bytes] = self._hear(every.level_dbm, every.sensitivity_dbm, size_bytes)
        return every.heard[size_bytes]

    def _hear(self, level_dbm: Floats, sensitivity_dbm: Floats, size_bytes: int) -> ReceivedSignal:
        snr_db = self.over_noise(level_dbm)
        detected = (level_dbm >= sensitivity_dbm) & self.noticed(snr_db)
        return ReceivedSignal(snr_db, detected, None if self.errors is None else self.errors.frame_hazard(snr_db, size_bytes))

    def over_noise(self, level_dbm: Floats) -> Floats:
        """Signal to noise ratio at some levels, (n,) dB."""
        return sealed(level_dbm - self.noise_dbm)

    def noticed(self, sinr_db: Floats) -> Bools:
        """Where a preamble stands out enough."""
        stands_out: Bools = sinr_db >= self.preamble_db
        return stands_out

    def weakness(self, mean: MeanBudget) -> Codes:
        """Of a signal that is too weak, what made it so: the first of distance, walls, shadowing that did; else fading."""
        if mean.weakness is None:
            if mean.together is None:
                mean.weakness = self._weakness(mean)
            else:
                every, which = mean.together
                if every.weakness is None:
                    every.weakness = _by_distance(every.level_dbm, self._least_dbm(every.sensitivity_dbm))
                mean.weakness = every.weakness[which]
        return mean.weakness

    def weaknesses(self, means: Sequence[MeanBudget]) -> Codes:
        """`weakness` of k budgets, (k, n)."""
        return np.stack([self.weakness(mean) for mean in means])

    def _least_dbm(self, sensitivity_dbm: Floats) -> Floats:
        """The weakest level that is noticed where nobody else sends."""
        least_dbm: Floats = np.maximum(sensitivity_dbm, self.noise_dbm + self.preamble_db)
        return least_dbm

    def _weakness(self, mean: MeanBudget) -> Codes:
        least, level = self._least_dbm(mean.sensitivity_dbm), mean.power_dbm - mean.path_loss_db
        why = _by_distance(level, least)
        for loss_db, name in ((mean.wall_loss_db, WALLS), (mean.shadowing_db, SHADOWING)):
            if loss_db is not None:
                level = level - loss_db
                why = np.where((why == FADING) & ~(level >= least), np.uint8(name), why)
        return why
