"""The mean link budget of one radio's links, and what receivers make of frames at some level."""

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
    walls: Ints | None = None  # how many are crossed; None: there are none in the chain
    materials: tuple[str, ...] | None = None  # of the walls that are crossed, e.g. "2 brick, 1 wood"
    wall_loss_db: Floats | None = None
    shadowing_db: Floats | None = None
    heard: dict[int, "ReceivedSignal"] = msgspec.field(default_factory=dict)  # of sizes, at this level: filled by `Hearing`
    parts: dict[int | None, "ReportColumns"] = msgspec.field(
        default_factory=dict
    )  # by the first who is meant: filled by `told`
    weakness: Codes | None = None  # what would make frames too weak: the same
    together: "tuple[BatchBudget, int] | None" = None  # with whose it was worked out, and which of them it is

    @cached_property
    def power_mw(self) -> Floats:
        """The level at all radios, (n + 1,) mW; 0 at itself."""
        if self.together is not None:
            every, which = self.together
            here: Floats = every.power_mw[which]
            return here
        return sealed(at_all(10.0 ** (self.level_dbm / 10.0), self.row))

    def told(self, receivers: tuple[str, ...], to: slice) -> "ReportColumns":
        """What reports of frames tell of it: of one receiver, or of all."""
        found = self.parts.get(to.start)
        if found is None:
            parts: list[Any] = [receivers, self.paths.distance_m, self.level_dbm, self.path_loss_db]
            parts += [self.walls, self.materials, self.wall_loss_db, self.shadowing_db]
            if to.start is not None:
                parts = [None if part is None else part[to] for part in parts]
            found = self.parts[to.start] = ReportColumns(*parts)
        return found


class BatchBudget(msgspec.Struct, dict=True):
    """Budgets of the links from each of k radios to all n others, by distance alone, worked out at once; see `MeanBudget`."""

    senders: list[SenderLinks]
    rows: NDArray[np.intp]  # (k,) of these radios among all
    apart: Bools  # (k, n + 1): a radio is another one
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

    def mean(self, which: int) -> MeanBudget:
        """The budget of one of them."""
        return MeanBudget(
            row=int(self.rows[which]),
            antennas=self.antennas,
            paths=Paths(self.tx[which], self.rx[which], self.distance_m[which], self.senders[which].seed),
            power_dbm=self.power_dbm[which],
            sensitivity_dbm=self.sensitivity_dbm[which],
            path_loss_db=self.path_loss_db[which],
            level_dbm=self.level_dbm[which],
            together=(self, which),
        )


class ReportColumns(msgspec.Struct, frozen=True):
    """The part of a mean budget that concerns those for whom a frame is meant; fields as of `MeanBudget`."""

    receivers: tuple[str, ...]
    distance_m: Floats
    level_dbm: Floats
    path_loss_db: Floats
    walls: Ints | None
    materials: tuple[str, ...] | None
    wall_loss_db: Floats | None
    shadowing_db: Floats | None


class ReceivedSignal(msgspec.Struct, frozen=True, dict=True):
    """How a frame that nobody else disturbs reaches n receivers, (n,) each."""

    snr_db: Floats
    detected: Bools
    hazard: Floats | None  # -log(chance that it survives the noise); None: it always does

    @cached_property
    def fate(self) -> Codes:
        """Its fate, but for the packet errors of those who are in doubt."""
        return sealed(np.where(self.detected, _RECEIVED, _UNDETECTED))

    @cached_property
    def doubtful(self) -> NDArray[np.intp]:
        """Who detects it and may yet lose it."""
        return self.in_doubt.nonzero()[0]

    @property
    def in_doubt(self) -> Bools:
        """Where it is detected and may yet be lost."""
        return np.zeros_like(self.detected) if self.hazard is None else self.detected & (self.hazard > _SURE)

    def of(self, which: int) -> "ReceivedSignal":
        """Of one radio of several, whose arrays are (k, n)."""
        return ReceivedSignal(self.snr_db[which], self.detected[which], None if self.hazard is None else self.hazard[which])


def at_all(values: Floats, row: int) -> Floats:
    """Values of all but one, with a zero for that one."""
    everywhere = np.zeros(len(values) + 1)  # np.insert and np.delete take ten times as long
    everywhere[:row] = values[:row]
    everywhere[row + 1 :] = values[row:]
    return everywhere
