"""Sockets in simulated time, for programs that can wait: their traffic is equal on any machine and at any speed.

The program's side alone, which imports little: the run's side is `netsim.sockets`.

::

    from vcmvsp.cosim.sockets import connect

    with connect("car1") as socket:             # waits for the run; the block ends with it
        while True:
            socket.sendto(b"hello", "car2")     # over the emulated radio; None: broadcast
            try:
                data, sender = socket.recvfrom(timeout=1.0)
            except TimeoutError:
                continue
            socket.sleep(0.5)

The scenario names the vehicles that have such a program: ``[sockets] vehicles = ["car1", "car2"]``. Time is simulated, and goes
on only in `Socket.sleep` and `Socket.recvfrom`: whatever a program does between two calls takes none of it, and the run waits.
"""

import math
import os
import socket as sockets
import time
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import NoReturn, Self

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.sockets.messages import (
    DEFAULT,
    EACH,
    LARGEST,
    LONGEST_NS,
    MOST_DOWN,
    VERSION,
    Down,
    Go,
    Hello,
    Over,
    Refused,
    Send,
    Stream,
    Up,
    Wait,
    Welcome,
    WireError,
    down,
    parsed,
)

VARIABLE = "VCMVSP_SOCKETS"
PAUSE_S = 0.05  # between two attempts to find the run
GREETING_S = 10.0


class RunOver(Exception):
    """The run has ended; nothing can be sent or received any more."""


def connect(vehicle: str, endpoint: str | None = None, *, timeout_s: float = 60.0) -> "Socket":
    """Take part in a run as the program of a vehicle; the answer comes at time 0, when all programs are there.

    Args:
        vehicle: its name, one of the scenario's ``sockets.vehicles``.
        endpoint: ``tcp/HOST:PORT`` or ``unix/PATH``; default: ``$VCMVSP_SOCKETS``, else ``tcp/127.0.0.1:7550``.
        timeout_s: for how long to look for the run, on the wall clock: either may be started first.

    Raises:
        ValueError: this is no endpoint.
        ConnectionError: no run listens there in time, or it rejects this program (with the reason).
    """
    where, until = endpoint or os.environ.get(VARIABLE) or DEFAULT, time.monotonic() + timeout_s
    while True:
        stream = Stream(_dialled(where, until), MOST_DOWN)
        try:
            if (welcome := _greeted(stream, vehicle)) is not None:
                return Socket(vehicle, welcome, stream)
        except BaseException:
            stream.socket.close()
            raise
        stream.socket.close()
        if time.monotonic() > until:
            raise ConnectionError(f"the listener at {where} is not a run that waits for programs")
        time.sleep(PAUSE_S)


class Socket:
    """The socket of a vehicle's program; see `connect`. It is for one thread.

    As a context manager it closes itself, and ends the block quietly when the run is over.

    Attributes:
        vehicle: whose it is.
        vehicles: names of all vehicles of the run.
        run: name of the scenario.
    """

    def __init__(self, vehicle: str, welcome: Welcome, stream: Stream) -> None:
        self.vehicle, self.vehicles, self.run, self._stream = vehicle, welcome.vehicles, welcome.run, stream
        self._inbox: deque[tuple[bytes, str]] = deque()
        self._held = 0  # bytes of them, as the run reckons
        self._now_ns = 0
        self._position: tuple[float, float, float] | None = None
        self._over: Exception | None = None
        self._wait_turn()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: TracebackType | None) -> bool:
        self.close()
        return isinstance(error, RunOver)

    def __iter__(self) -> Iterator[tuple[bytes, str]]:
        """All that is received until the run ends: data and sender."""
        while True:
            try:
                received = self.recvfrom()
            except RunOver:
                return
            yield received

    def time(self) -> float:
        """Simulated seconds since the start of the run."""
        return self._now_ns / SECOND_NS

    def time_ns(self) -> int:
        """Simulated time since the start of the run, ns."""
        return self._now_ns

    def position(self) -> tuple[float, float, float] | None:
        """Newest position of the vehicle from its `pose_source`, x, y, z in m; None: not known yet."""
        return self._position

    def sendto(self, data: bytes | bytearray | memoryview, to: str | None = None) -> int:
        """Send a datagram at the present instant; the answer is its size in bytes.

        Args:
            data: at most 65535 bytes.
            to: name of the receiver; None: broadcast.

        Raises:
            TypeError: no bytes.
            ValueError: too long, or not another vehicle of the run.
            RunOver: the run has ended.
            ConnectionError: the run has gone.
        """
        self._check()
        if to is not None and (to not in self.vehicles or to == self.vehicle):
            others = ", ".join(each for each in self.vehicles if each != self.vehicle)
            raise ValueError(f"sendto(to={to!r}): not another vehicle of this run ({others})")
        if not isinstance(data, bytes | bytearray | memoryview):
            raise TypeError(f"sendto() takes bytes, not a {type(data).__name__}")
        payload = bytes(data)
        if len(payload) > LARGEST:
            raise ValueError(f"sendto(): {len(payload)} bytes; a datagram has at most {LARGEST}")
        self._say(Send(to, payload))
        return len(payload)

    def recvfrom(self, timeout: float | None = None) -> tuple[bytes, str]:
        """Wait for a datagram: its data, and the vehicle that sent it.

        Args:
            timeout: for how long, simulated seconds; None: until the run ends. 0: what has come by now.

        Raises:
            TimeoutError: nothing has come.
            RunOver, ConnectionError: as `sendto`.
        """
        self._check()
        for_ns = None if timeout is None else _nanoseconds(timeout, "timeout")
        if not self._inbox and for_ns != 0:
            self._pass(for_ns, hears=True)
        if not self._inbox and timeout is None:
            self._end(ConnectionError("the run continues without an answer to this program"))
        if not self._inbox:
            raise TimeoutError(f"no message was received for {timeout:g} s")
        data, sender = self._inbox.popleft()
        self._held -= len(data) + EACH
        return data, sender

    def sleep(self, seconds: float) -> None:
        """Let simulated time go on; what is heard meanwhile waits for `recvfrom`, up to 4 MiB of it.

        Raises:
            RunOver, ConnectionError: as `sendto`.
        """
        self._check()
        if for_ns := _nanoseconds(seconds, "seconds"):
            self._pass(for_ns, hears=False)

    def close(self) -> None:
        """Leave the run: from now on the vehicle is silent."""
        if self._over is None:
            self._over = ValueError("the socket is closed")
        self._stream.socket.close()

    # --- what is said to the run, and by it ---------------------------------------------------------------------------------

    def _check(self) -> None:
        if self._over is not None:
            raise self._over

    def _pass(self, for_ns: int | None, *, hears: bool) -> None:
        self._say(Wait(for_ns, hears, self._held))
        self._wait_turn()

    def _wait_turn(self) -> None:
        word = self._next()
        if isinstance(word, Over):
            self._end(RunOver("the run is over"))
        if not isinstance(word, Go):
            self._end(ConnectionError("the run sent an invalid answer"))
        self._now_ns, self._position = word.time_ns, word.position
        self._inbox.extend(word.heard)
        self._held += sum(len(data) + EACH for data, _ in word.heard)

    def _say(self, message: Up) -> None:
        try:
            self._stream.send(message)
        except OSError:  # it has gone, and may have said before that it is over
            while not isinstance(self._next(), Over):
                pass
            self._end(RunOver("the run is over"))

    def _next(self) -> Down:
        try:
            if (message := self._stream.receive()) is None:
                raise ConnectionError("the run closed it")
            return down(message)
        except (OSError, WireError) as error:
            self._end(ConnectionError(f"the connection to the run is lost: {error}"))

    def _end(self, error: Exception) -> NoReturn:
        self._over = error
        raise error


def _nanoseconds(seconds: float, name: str) -> int:
    if not 0.0 <= seconds < math.inf or (for_ns := seconds_to_ns(seconds)) > LONGEST_NS:
        raise ValueError(f"{name} = {seconds} must be from 0 to {LONGEST_NS // SECOND_NS} s")
    return for_ns


def _greeted(stream: Stream, vehicle: str) -> Welcome | None:
    """The answer to a greeting; None: the other end says nothing that makes sense, or is about to end."""
    stream.socket.settimeout(GREETING_S)
    try:
        stream.send(Hello(VERSION, vehicle))
        message = stream.receive()
        word = None if message is None else down(message)
    except (OSError, WireError):
        return None
    stream.socket.settimeout(None)
    if isinstance(word, Refused):
        raise ConnectionRefusedError(f"the run rejects the program of '{vehicle}': {word.why}")
    return word if isinstance(word, Welcome) else None


def _dialled(endpoint: str, until: float) -> sockets.socket:
    where = parsed(endpoint)
    while True:
        try:
            end = _connected(where)
            if end.family == sockets.AF_UNIX or end.getsockname() != end.getpeername():  # it may find itself, where nobody is
                return end
            end.close()
        except OSError as error:
            if time.monotonic() > until:
                problem = f"no run waits for programs at {endpoint} ({error.strerror or error})"
                raise ConnectionRefusedError(f"{problem}: start the run, or set its endpoint, here or in ${VARIABLE}") from None
        time.sleep(PAUSE_S)


def _connected(where: str | tuple[str, int]) -> sockets.socket:
    if isinstance(where, tuple):
        return sockets.create_connection(where)
    end = sockets.socket(sockets.AF_UNIX)
    try:
        end.connect(where)
    except BaseException:
        end.close()
        raise
    return end
