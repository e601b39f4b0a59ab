"""Receptions of a frame, and the `Traffic` events of programs' datagrams."""

from collections.abc import Iterator

import numpy as np

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import FrameReport, Traffic, frozen


class TrafficLog:
    """Reports, arrivals and settled datagrams since the last event."""

    def __init__(self) -> None:
        self._clear()

    def report(self, report: FrameReport, datagram: int) -> None:
        """Add the report of a frame with a datagram."""
        self._reports.append(report)
        self._carries.append(datagram)

    def arrive(self, datagram: int, receiver: int, at_ns: int, frame: int) -> None:
        """Add an arrival of a datagram at the vehicle of this row."""
        self._arrivals.append((datagram, receiver, at_ns, frame))

    def settle(self, datagram: int) -> None:
        """Add a datagram without further arrivals."""
        self._settled.append(datagram)

    def events(self, now_ns: int) -> Iterator[Event]:
        """One event with everything since the last one, if there is anything."""
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
    """Receiver, level (dBm) and time (ns) of each reception of a frame, copies included."""
    for arrival_ns in (report.received_ns,) if report.copy_ns is None else (report.received_ns, report.copy_ns):
        for arrived in zip(report.receivers, report.rssi_dbm.tolist(), arrival_ns.tolist(), strict=True):
            if arrived[2] >= 0:
                yield arrived
