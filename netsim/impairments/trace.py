"""Trace-driven links: what was measured, or computed elsewhere, in place of the models."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.trace_file import LEVELS, TraceRows, read_rows
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Floats, Frame, Ints


class Moment(NamedTuple):
    """Where n links are in their traces at one instant: between two rows each, or twice at the same row."""

    traced: Bools  # (n,) whether the trace names the link
    before: NDArray[np.intp]  # (n,) row that counts
    after: NDArray[np.intp]  # (n,) the next one; where there is none, or values are held: the same
    weight: Floats  # (n,) of the latter, 0 to 1


@dataclass(frozen=True)
class Trace:
    """Links as a file has them: a row for each instant, sender and receiver, with what holds from then on.

    The file is CSV with a header, or Parquet. Its columns are ``time_s``, ``sender``, ``receiver``, and any of

    ===========================  =======================================================================================
    ``snr_db`` or ``rssi_dbm``   received level, above noise or absolute: instead of power, loss on the way, and fading
    ``loss``                     probability that a frame is lost: instead of what the models lose
    ``delay_s``                  from sending to reception, instead of the models'; but no frame arrives before its end
    ===========================  =======================================================================================

    A row concerns one direction. Between rows the last one holds, or, with ``interpolate``, values go in straight lines over
    time (levels in dB); before a link's first row that one holds, after its last row that one. Of rows with the same time the
    last one counts. A frame has the values of the time at which it begins on the air. Links that the file does not name are
    left to the models.

    Args:
        file: path of a CSV or Parquet file with the columns ``time_s``, ``sender``, ``receiver`` and any of ``snr_db`` or
            ``rssi_dbm``, ``loss``, ``delay_s``; in a scenario relative to its folder.
        interpolate: straight lines between the rows, instead of steps.
        noise_dbm: what ``snr_db`` is counted from: the noise of the radio.
    """

    file: str
    interpolate: bool = False
    noise_dbm: float | None = None
    cause: ClassVar[str] = "traced loss"

    def __post_init__(self) -> None:
        if "snr_db" in self._rows.values and self.noise_dbm is None:
            raise ScenarioError("must be given: the file has snr_db, levels above it", key="noise_dbm")

    @property
    def columns(self) -> tuple[str, ...]:
        """Which quantities the file has: ``snr_db`` or ``rssi_dbm``, ``loss``, ``delay_s``."""
        return tuple(self._rows.values)

    def names(self) -> tuple[str, ...]:
        """All senders and receivers in the file, sorted."""
        return tuple(sorted({name for link in self._rows.links for name in link}))

    def traced(self, frame: Frame) -> Bools:
        """Which of the frame's links the file names, (n,)."""
        return self._links(frame.sender, frame.receivers) >= 0

    def level_dbm(self, frame: Frame) -> Floats:
        """Level at each receiver, (n,) dBm; NaN where the file does not say."""
        column = next((name for name in LEVELS if name in self._rows.values), None)
        if column is None:
            return np.full(len(frame.receivers), np.nan)
        level = self._at(column, frame, untraced=np.nan)
        return level if column == "rssi_dbm" or self.noise_dbm is None else level + self.noise_dbm

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,); none where the file does not say."""
        if "loss" not in self._rows.values:
            return np.zeros(len(frame.receivers), np.bool_)
        lost: Bools = draw()[..., 0] < self._at("loss", frame, untraced=0.0)
        return lost

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) ns; 0 where the file does not say."""
        if "delay_s" not in self._rows.values:
            return np.zeros(len(frame.receivers), np.int64)
        delay: Ints = np.rint(self._at("delay_s", frame, untraced=0.0) * SECOND_NS).astype(np.int64)
        return delay

    def _at(self, column: str, frame: Frame, untraced: float) -> Floats:
        """A column at the frame's time, (n,)."""
        values, moment = self._rows.values[column], self._moment(frame.start_ns, frame.sender, frame.receivers)
        now = values[moment.before]
        if self.interpolate:
            now = now + moment.weight * (values[moment.after] - now)
        return np.where(moment.traced, now, untraced)

    def _find(self, time_ns: int, sender: str, receivers: tuple[str, ...]) -> Moment:
        rows, links = self._rows, self._links(sender, receivers)
        traced, links = links >= 0, np.maximum(links, 0)  # what is not traced may find any row
        first, last = rows.first[links], rows.first[links + 1] - 1
        # Rows are sorted by link and time. One search finds all: for the number of the link, and how many times had passed.
        passed = np.searchsorted(rows.times_ns, time_ns, side="right")
        before = np.maximum(np.searchsorted(rows.order, links * rows.stride + passed) - 1, first)
        if not self.interpolate:
            return Moment(traced, before, before, np.zeros(len(links)))
        after = np.minimum(before + 1, last)
        begin, end = rows.row_ns[before], rows.row_ns[after]
        weight = np.clip((time_ns - begin) / np.maximum(end - begin, 1), 0.0, 1.0)
        return Moment(traced, before, after, weight)

    @cached_property
    def _rows(self) -> TraceRows:
        return read_rows(self.file)

    # The questions about one frame share an answer: all are asked before the next frame's.
    @cached_property
    def _moment(self) -> Callable[[int, str, tuple[str, ...]], Moment]:
        return lru_cache(maxsize=64)(self._find)

    @cached_property
    def _links(self) -> Callable[[str, tuple[str, ...]], NDArray[np.intp]]:
        """The number of each link in the file, (n,); -1: not there."""
        number = {link: k for k, link in enumerate(self._rows.links)}

        def links(sender: str, receivers: tuple[str, ...]) -> NDArray[np.intp]:
            return np.array([number.get((sender, receiver), -1) for receiver in receivers], np.intp)

        return lru_cache(maxsize=4096)(links)
