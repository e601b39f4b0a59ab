"""Admission of programs to a run: a local socket, and the wait for one program of each vehicle."""

import contextlib
import errno
import selectors
import socket
import stat
import time
from collections.abc import Sequence
from pathlib import Path

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.sockets.messages import MOST_UP, PIECE, VERSION, Hello, Refused, Stream, Up, Welcome, WireError, parsed, up
from vcmvsp.cosim.transport.endpoints import is_loopback
from vcmvsp.cosim.util.text import LONGEST_NAME, Tell, plain

MOST_STRANGERS = 64  # connections without a `Hello` message
GREETING_S = 5.0  # timeout of the `Hello` message
MOST_TOLD = 20  # reported refusals


def check_endpoint(endpoint: str) -> None:
    """Raise a `ValueError` for an invalid endpoint, or one that other machines reach."""
    where = parsed(endpoint)
    if isinstance(where, tuple) and not is_loopback(where[0]):
        port = where[1]
        problem = f"{endpoint}: programs do not authenticate, so other machines cannot connect"
        tunnel = f"ssh -L {port}:127.0.0.1:{port} THIS_MACHINE"
        raise ValueError(f"{problem}: listen on tcp/127.0.0.1:{port} or unix/PATH, and connect remote programs by {tunnel}")


class Listener:
    """A listening socket; ``endpoint``: its endpoint, with a real port instead of port 0.

    Raises:
        ScenarioError: it cannot listen there.
    """

    def __init__(self, endpoint: str) -> None:
        where, self._path = parsed(endpoint), None
        self.endpoint = endpoint
        try:
            if isinstance(where, str):
                self.socket = _listening_here(where)
                self._path = Path(where)
            else:
                host, port = where
                family = socket.AF_INET6 if ":" in host else socket.AF_INET
                self.socket = socket.create_server((host, port), family=family, backlog=MOST_STRANGERS)
                self.endpoint = f"{endpoint.rpartition(':')[0]}:{self.socket.getsockname()[1]}"
        except OSError as error:
            in_use = "another run may use it; " if error.errno == errno.EADDRINUSE else ""
            problem = f"cannot listen on {endpoint}: {error.strerror or error}; {in_use}choose another endpoint"
            raise ScenarioError(problem, key="sockets.listen") from error
        self.socket.setblocking(False)

    def close(self) -> None:
        """Stop to listen."""
        self.socket.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)
            self._path = None


def _listening_here(path: str) -> socket.socket:
    """A Unix socket for this user only; replaces a stale one."""
    end = socket.socket(socket.AF_UNIX)
    try:
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISSOCK(Path(path).stat().st_mode) and not _answers(path):
                Path(path).unlink()
        end.bind(path)
        Path(path).chmod(0o600)  # before `listen`, so that no other user can connect
        end.listen(MOST_STRANGERS)
    except BaseException:
        end.close()
        raise
    return end


def _answers(path: str) -> bool:
    with socket.socket(socket.AF_UNIX) as end:
        return end.connect_ex(path) == 0


class ProgramAdmission:
    """Waits for one program of each vehicle in ``expected``; silent or invalid connections are dismissed."""

    def __init__(self, listener: Listener, expected: Sequence[str], run: str, vehicles: Sequence[str], tell: Tell) -> None:
        self._listener, self._expected, self._tell = listener, tuple(expected), tell
        self._welcome = Welcome(run, tuple(vehicles))
        self._strangers: dict[Stream, float] = {}  # deadlines of their `Hello`, oldest first
        self._connections: dict[str, Stream] = {}
        self._remarks: set[str] = set()
        self._selector = selectors.DefaultSelector()

    def wait(self, timeout_s: float) -> dict[str, Stream]:
        """The connections of all programs, by vehicle. Raises `FederateError` (a program is missing after the timeout)."""
        until = time.monotonic() + timeout_s
        self._selector.register(self._listener.socket, selectors.EVENT_READ)
        try:
            while missing := self._missing():
                remaining_s = until - time.monotonic()
                if remaining_s <= 0.0:
                    late = f"no program connected for {missing} within {timeout_s:g} s (sockets.join_timeout_s)"
                    advice = f"start one for each: cosim.sockets.connect(VEHICLE, '{self._listener.endpoint}')"
                    raise FederateError("sockets", f"{late}; {advice}")
                for key, _ in self._selector.select(min(remaining_s, GREETING_S)):
                    if key.data is None:
                        self._accept()
                    else:
                        self._read(key.data)
                now = time.monotonic()
                for stream in [each for each, last in self._strangers.items() if last < now]:
                    self._dismiss(stream)
            connections, self._connections = self._connections, {}
            return connections
        finally:
            self._selector.close()
            for stream in (*self._strangers, *self._connections.values()):
                stream.socket.close()

    def _missing(self) -> str:
        return ", ".join(each for each in self._expected if each not in self._connections)

    def _accept(self) -> None:
        try:
            end, _ = self._listener.socket.accept()
        except OSError:  # it has gone again, or there are too many
            return
        end.setblocking(False)
        stream = Stream(end, MOST_UP)
        self._strangers[stream] = time.monotonic() + GREETING_S
        self._selector.register(end, selectors.EVENT_READ, stream)
        if len(self._strangers) > MOST_STRANGERS:
            self._dismiss(next(iter(self._strangers)))

    def _dismiss(self, stream: Stream) -> None:
        self._strangers.pop(stream, None)
        self._selector.unregister(stream.socket)
        stream.socket.close()

    def _read(self, stream: Stream) -> None:
        if stream.socket.fileno() < 0:
            return  # dismissed a moment ago
        try:
            piece = stream.socket.recv(PIECE)
            stream.frames.feed(piece)
            message = stream.frames.next()
            word = None if message is None else up(message)
        except BlockingIOError:
            return
        except (OSError, WireError):
            piece, word = b"", None
        if stream not in self._strangers:
            self._lose(stream)
        elif not piece:
            self._dismiss(stream)
        elif word is not None:
            self._answer(stream, word)

    def _lose(self, stream: Stream) -> None:
        (vehicle,) = [name for name, each in self._connections.items() if each is stream]
        del self._connections[vehicle]
        self._dismiss(stream)
        self._tell(f"the program of {vehicle} disconnected; waiting for another")

    def _answer(self, stream: Stream, word: Up) -> None:
        why = self._refusal(word)
        with contextlib.suppress(OSError):
            stream.send(self._welcome if why is None else Refused(why))
        if why is not None or not isinstance(word, Hello):
            self._dismiss(stream)
            return
        del self._strangers[stream]
        self._connections[word.vehicle] = stream
        self._tell(f"the program of {word.vehicle} connected; still waiting for: {self._missing() or 'none'}")

    def _refusal(self, word: Up) -> str | None:
        if not isinstance(word, Hello):
            return "its first message does not name its vehicle"
        if word.version != VERSION:
            return f"it uses protocol version {word.version}, the run uses {VERSION}: install one vcmvsp version for both"
        if word.vehicle not in self._expected:
            why = unknown("vehicle", plain(word.vehicle, LONGEST_NAME), self._expected) + " (sockets.vehicles)"
        elif word.vehicle in self._connections:
            why = f"{word.vehicle} already has a program"
        else:
            return None
        if why not in self._remarks and len(self._remarks) < MOST_TOLD:
            self._remarks.add(why)
            self._tell(f"refused a program: {why}")
        return why
