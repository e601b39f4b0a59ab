"""Mean link budgets of radios, and signals without interference."""

from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints, Paths, SenderLinks, sealed
from vcmvsp.netsim.interfaces.medium import Codes, Fate

_RECEIVED, _UNDETECTED = np.uint8(Fate.RECEIVED), np.uint8(Fate.UNDETECTED)
_SURE = 2.0**-54  # a hazard that no draw is below, but for 0


class MeanBudget(msgspec.Struct, dict=True):
    """The mean budget of the links from one radio to n others, (n,) each."""

    row: int  # of the radio among all
    antennas: Floats  # of all, (n + 1, 3) m, world
    paths: Paths
    power_dbm: Floats  # transmitted, with both antennas
    sensitivity_dbm: Floats
    path_loss_db: Floats
    level_dbm: Floats
    walls: Ints | None = None  # number of walls crossed; None: no walls in the channel
    materials: tuple[str, ...] | None = None  # of the walls that are crossed, e.g. "2 brick, 1 wood"
    wall_loss_db: Floats | None = None
    shadowing_db: Floats | None = None
    heard: dict[int, "ReceivedSignal"] = msgspec.field(default_factory=dict)  # of sizes, at this level: filled by `Hearing`
    parts: dict[int | None, "ReportColumns"] = msgspec.field(
        default_factory=dict
    )  # by place of the first receiver: filled by `report_columns`
    weakness: Codes | None = None  # cause of a signal that is too weak: the same
    together: "tuple[BatchBudget, int] | None" = None  # batch in which it was computed, and its row there

    @cached_property
    def power_mw(self) -> Floats:
        """The level at all radios, (n + 1,) mW; 0 at itself."""
        if self.together is not None:
            every, which = self.together
            here: Floats = every.power_mw[which]
            return here
        return sealed(at_all(10.0 ** (self.level_dbm / 10.0), self.row))

    def report_columns(self, receivers: tuple[str, ...], to: slice) -> "ReportColumns":
        """Columns of frame reports for one receiver, or for all."""
        columns = self.parts.get(to.start)
        if columns is None:
            parts: list[Any] = [receivers, self.paths.distance_m, self.level_dbm, self.path_loss_db]
            parts += [self.walls, self.materials, self.wall_loss_db, self.shadowing_db]
            if to.start is not None:
                parts = [None if part is None else part[to] for part in parts]
            columns = self.parts[to.start] = ReportColumns(*parts)
        return columns


class BatchBudget(msgspec.Struct, dict=True):
    """Budgets from each of k radios to all n others, which depend on distance alone; see `MeanBudget`."""

    senders: list[SenderLinks]
    rows: NDArray[np.intp]  # (k,) of these radios among all
    apart: Bools  # (k, n + 1): False at the sender itself
    antennas: Floats
    tx: Floats  # (k, 3) m, world
    rx: Floats  # (k, n, 3) m, world
    distance_m: Floats  # (k, n)
    power_dbm: Floats  # (k, n)
    sensitivity_dbm: Floats  # (k, n)
    path_loss_db: Floats  # (k, n)
    level_dbm: Floats  # (k, n)
    heard: dict[int, "ReceivedSignal"] = msgspec.field(default_factory=dict)  # see `MeanBudget`, (k, n)
    weakness: Codes | None = None  # the same

    @cached_property
    def power_mw(self) -> Floats:
        """See `MeanBudget`, (k, n + 1)."""
        everywhere = np.zeros(self.apart.shape)
        everywhere[self.apart] = (10.0 ** (self.level_dbm / 10.0)).ravel()
        return sealed(everywhere)

    def means(self) -> list[MeanBudget]:
        """The budget of each radio."""
        columns = (self.rows.tolist(), self.tx, self.rx, self.distance_m)
        levels = (self.power_dbm, self.sensitivity_dbm, self.path_loss_db, self.level_dbm)
        seed, means = self.senders[0].seed, list[MeanBudget]()
        rows = zip(*columns, *levels, strict=True)
        for k, (row, tx, rx, distance_m, power_dbm, sensitivity_dbm, path_loss_db, level_dbm) in enumerate(rows):
            of_row = power_dbm, sensitivity_dbm, path_loss_db, level_dbm
            paths, together = Paths(tx, rx, distance_m, seed), (self, k)
            means.append(MeanBudget(row, self.antennas, paths, *of_row, together=together))
        return means


class ReportColumns(msgspec.Struct, frozen=True):
    """Part of a mean budget at the receivers of a frame; fields: see `MeanBudget`."""

    receivers: tuple[str, ...]
    distance_m: Floats
    level_dbm: Floats
    path_loss_db: Floats
    walls: Ints | None
    materials: tuple[str, ...] | None
    wall_loss_db: Floats | None
    shadowing_db: Floats | None


class ReceivedSignal(msgspec.Struct, frozen=True, dict=True):
    """Signal of a frame without interference at n receivers, (n,) each; of a batch (k, n)."""

    snr_db: Floats
    detected: Bools
    hazard: Floats | None  # -log(chance that it survives the noise); None: it always does

    @cached_property
    def fate(self) -> Codes:
        """Fate before packet errors."""
        return sealed(np.where(self.detected, _RECEIVED, _UNDETECTED))

    @cached_property
    def doubtful(self) -> tuple[NDArray[np.intp], ...]:
        """Indices at which a frame is detected and may yet be lost, one array for each dimension."""
        if self.hazard is None:
            return (np.zeros(0, np.intp),) * self.detected.ndim
        return (self.detected & (self.hazard > _SURE)).nonzero()

    @cached_property
    def batch(self) -> "ReceivedSignal":
        """The same signal as a batch of one, (1, n)."""
        return ReceivedSignal(self.snr_db[None], self.detected[None], None if self.hazard is None else self.hazard[None])

    def rows(self, which: int | list[int]) -> "ReceivedSignal":
        """One row of a batch, (n,), or several, (k, n)."""
        return ReceivedSignal(self.snr_db[which], self.detected[which], None if self.hazard is None else self.hazard[which])


def at_all(values: Floats, row: int) -> Floats:
    """Insert a zero at a row."""
    everywhere = np.zeros(len(values) + 1)  # np.insert and np.delete take ten times as long
    everywhere[:row] = values[:row]
    everywhere[row + 1 :] = values[row:]
    return everywhere
