"""A feed and its reader on a clock of their own, and events for it."""

import socket
import struct
from collections.abc import Iterator
from typing import Any, Self

import msgspec
import numpy as np

from tests.support.cosim.recordings import frame, states
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.received import receptions_at
from vcmvsp.cosim.types import Later, Message, Reading, Reception, Receptions, frozen
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import PERIOD_S, Feed
from vcmvsp.cosim.view.messages import Craft, Obstacle, Pace, PageUpdate, Scenery

NAMES = ("a", "b", "c")
NOTHING = frozen(np.zeros((0, 3)))
SCENERY = Scenery(
    scenario="s",
    seed=0,
    duration_ns=SECOND_NS,
    vehicles=tuple(Craft(name=name, kind="point", size=(1.0, 1.0, 1.0)) for name in NAMES),
    vertices=NOTHING,
    triangles=NOTHING,
    colors=NOTHING,
    obstacles=(Obstacle(name="crate", shape="box", size=(1.0, 1.0, 1.0), pose=(1.0, 2.0, 0.5, 0.0), color=(1, 2, 3)),),
)


class Reader:
    """A feed, and a reader of its output, on a clock of their own."""

    def __init__(self, buffer_bytes: int | None = None, **more: Any) -> None:
        ours, self.sock = socket.socketpair()
        if buffer_bytes is not None:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer_bytes)
        self.sock.setblocking(False)
        self.now_s, self._got = 0.0, b""
        self._pipe = protocol.Pipe(ours)
        self.feed = Feed(self._pipe, more.pop("scenery", SCENERY), clock=lambda: self.now_s, **more)
        self.newest: PageUpdate | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.sock.close()
        self._pipe.close()

    def on(self, time_ns: int, key: str, value: Any) -> None:
        self.feed.on(Event(key, time_ns, value))

    def wait(self, wall_s: float = PERIOD_S) -> None:
        """Let time pass while the run stands still."""
        self.now_s += wall_s
        self.feed.pace(Pace())

    def read(self, most: int = 1 << 30) -> list[PageUpdate]:
        """Read at most a number of bytes; returns the messages that are complete now, with the state after each."""
        while most > 0:
            try:
                data = self.sock.recv(min(most, 1 << 16))
            except BlockingIOError:
                break
            self._got, most = self._got + data, most - len(data)
        shown = list(self._whole())
        for each in shown:
            self.newest = merge(self.newest, each)
        return shown

    def known(self) -> PageUpdate:
        self.read()
        assert self.newest is not None
        return self.newest

    def order(self, payload: bytes) -> None:
        self.sock.sendall(struct.pack("<I", len(payload)) + payload)

    def read_all(self) -> PageUpdate:
        """Read until nothing is left, while time passes."""
        self.wait()
        while self.read() or self._got:
            self.wait()
        return self.known()

    def _whole(self) -> Iterator[PageUpdate]:
        while len(self._got) >= 4 and len(self._got) >= 4 + (length := struct.unpack_from("<I", self._got)[0]):
            yield protocol.shows.decode(self._got[4 : 4 + length])
            self._got = self._got[4 + length :]


def merge(older: PageUpdate | None, newer: PageUpdate) -> PageUpdate:
    """Two messages as one: the newest value of everything, and every line."""
    if older is None:
        return newer
    fields = {name: getattr(older, name) for name in PageUpdate.__struct_fields__}
    merged = {name: before | getattr(newer, name) for name, before in fields.items() if isinstance(before, dict)}
    merged |= {name: fields[name] for name in ("states", "sent", "received") if getattr(newer, name) is None}
    links = {link.sender: link for link in (*older.links, *newer.links)}
    lines = (*older.lines, *newer.lines)
    return msgspec.structs.replace(newer, **merged, links=tuple(links.values()), lines=lines)


def at(x: float) -> Any:
    return states(0, dict.fromkeys(NAMES, (x, 0.0, 0.0))).value


def frame_of(number: int, sender: str, received: dict[str, int | None]) -> Any:
    return frame(number, sender, number, received).value


def receptions(received_ns: int) -> Receptions:
    message = Message(sender="b", body={}, size_bytes=1)
    reception = Reception(message=message, rssi_dbm=-50.0, sent_ns=received_ns - 1, received_ns=received_ns)
    return receptions_at("a", [reception], NAMES)


class CountedReadings:
    """Readings that are computed on access, and the number of accesses."""

    def __init__(self, reading: Reading) -> None:
        self.reading, self.times = reading, 0

    def later(self) -> Later:
        return Later(self._work)

    def _work(self) -> Reading:
        self.times += 1
        return self.reading
