"""Servers of emulated devices: a thread that serves a device at its port, and TCP ports."""

import contextlib
import os
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.util.polling import readable

LOOPBACK = "127.0.0.1"
"""What is served there reaches nobody but this machine."""

_PAUSE_NS = 100_000_000  # longest sleep
_CLOSE_S = 5.0  # the thread ends within one sleep
_READ = 65_535  # bytes


class DeviceServer(ABC):
    """Serves a device at a port by a thread, which starts at once; a context manager, which closes it.

    Args:
        url: of the port.
        unplug: releases the port.

    Attributes:
        url: of the port.
        error: error that ended the thread, if any; `close` raises it.
    """

    def __init__(self, url: str, unplug: Callable[[], None]) -> None:
        self.url, self._unplug = url, unplug
        self.error: Exception | None = None
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"serve {url}", daemon=True)
        self._thread.start()

    @abstractmethod
    def _due_ns(self) -> int | None:
        """Monotonic time of the next `_turn`; None: not before bytes arrive."""

    @abstractmethod
    def _waits_on(self) -> int | None:
        """Descriptor that becomes readable when bytes arrive, if any."""

    @abstractmethod
    def _turn(self) -> None:
        """Process received bytes, and send what is due."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread, and release the port. May be called twice."""
        if self._wake_write < 0:
            return
        os.write(self._wake_write, b"x")
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            raise RuntimeError(f"the device at {self.url} does not stop being served")
        self._unplug()
        os.close(self._wake_read)
        os.close(self._wake_write)
        self._wake_write = -1
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            while not self._stopped():
                self._turn()
        except Exception as error:
            self.error = error

    def _stopped(self) -> bool:
        """Sleep until something is due or arrives; whether to stop."""
        due_ns, now_ns = self._due_ns(), time.monotonic_ns()
        pause_ns = _PAUSE_NS if due_ns is None else max(0, min(due_ns - now_ns, _PAUSE_NS))
        waits_on = [each for each in (self._wake_read, self._waits_on()) if each is not None]
        return self._wake_read in readable(waits_on, pause_ns / SECOND_NS)


class TcpListener:
    """A TCP port for one client at a time; the next one is accepted after the last has closed its connection."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port), backlog=1)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self.url = f"{scheme}{host}:{self._listener.getsockname()[1]}"

    def waits_on(self) -> int:
        """Descriptor that becomes readable when there is something to `read`."""
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        """Bytes of the client, or none."""
        if self._client is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(_READ)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> int:
        """Send as much as possible without waiting; number of bytes."""
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return 0

    def baud(self) -> None:
        """A TCP connection has no baud rate."""

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Hang up, and free the port."""
        self._hang_up()
        self._listener.close()
