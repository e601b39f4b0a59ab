"""What there is to tell of frames: who received one, and what became of the datagrams of programs."""

from collections.abc import Iterator

import numpy as np

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import FrameReport, Traffic, frozen


class TrafficLog:
    """What became known of datagrams since it was told last."""

    def __init__(self) -> None:
        self._clear()

    def report(self, report: FrameReport, datagram: int) -> None:
        """A frame that carried one."""
        self._reports.append(report)
        self._carries.append(datagram)

    def arrive(self, datagram: int, receiver: int, at_ns: int, frame: int) -> None:
        """One arrives at the vehicle of this row, by this frame."""
        self._arrivals.append((datagram, receiver, at_ns, frame))

    def settle(self, datagram: int) -> None:
        """Nothing is to come of one any more."""
        self._settled.append(datagram)

    def events(self, now_ns: int) -> Iterator[Event]:
        """One for all of them, if there is anything to tell; then it is told."""
        if not (self._reports or self._arrivals or self._settled):
            return
        columns = np.array(self._arrivals, np.int64).reshape(-1, 4).T
        traffic = Traffic(
            reports=tuple(self._reports),
            carries=frozen(self._carries, np.int64),
            number=frozen(columns[0]),
            receiver=frozen(columns[1], np.int32),
            arrival_ns=frozen(columns[2]),
            frame=frozen(columns[3]),
            settled=frozen(self._settled, np.int64),
        )
        self._clear()
        yield Event("radio/traffic", now_ns, traffic)

    def _clear(self) -> None:
        self._reports: list[FrameReport] = []
        self._carries: list[int] = []
        self._arrivals: list[tuple[int, int, int, int]] = []
        self._settled: list[int] = []


def received(report: FrameReport) -> Iterator[tuple[str, float, int]]:
    """Who received a frame, at which level, and when; who received it twice, twice."""
    for arrival_ns in (report.received_ns,) if report.copy_ns is None else (report.received_ns, report.copy_ns):
        for arrived in zip(report.receivers, report.rssi_dbm.tolist(), arrival_ns.tolist(), strict=True):
            if arrived[2] >= 0:
                yield arrived
