"""The run's side of one program: wake time, turns, and waiting datagrams."""

import contextlib
import socket
from collections import deque

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.sockets.messages import EACH, ROOM, Go, Over, Send, Stream, Up, Wait, WireError, up
from vcmvsp.cosim.types import Message, Vec3
from vcmvsp.cosim.util.text import plain

MOST_CALLS = 100_000  # datagrams in one turn
MOST_BYTES = 1 << 26  # in one turn


class ProgramLeft(Exception):
    """A program has ended or was dismissed; the message is the reason."""


class Program:
    """The program of a vehicle.

    Attributes:
        wake_ns: time of the next turn at the latest; None: at the next reception only.
        missed: datagrams dropped because the program did not read.
        noted: how many of them were noted.
        position: estimate of its vehicle, m, world.

    Args:
        vehicle: of the program.
        vehicles: all of the run.
        stream: the connection.
        deadline_s: wall-clock timeout of each message in its turn.
    """

    def __init__(self, vehicle: str, vehicles: frozenset[str], stream: Stream, deadline_s: float | None) -> None:
        self.vehicle, self._stream, self._deadline_s = vehicle, stream, deadline_s
        self._others = vehicles - {vehicle}
        self.wake_ns: int | None = 0
        self.missed = self.noted = 0
        self.position: Vec3 | None = None
        self._wakes_on_reception = False
        self._received: deque[tuple[bytes, str]] = deque()
        self._room = ROOM
        stream.socket.settimeout(deadline_s)

    def fileno(self) -> int:
        """For poll."""
        return self._stream.socket.fileno()

    def hear(self, payload: bytes, sender: str) -> None:
        """Store a datagram for the next turn, if there is room."""
        size = len(payload) + EACH
        if size > self._room:
            self.missed += 1
        else:
            self._received.append((payload, sender))
            self._room -= size

    def is_due(self, now_ns: int) -> bool:
        """Whether its turn is now."""
        return self.wake_ns == now_ns or (self._wakes_on_reception and bool(self._received))

    def turn(self, now_ns: int, messages: list[Message]) -> None:
        """Run it until it waits again; appends its messages to ``messages``.

        Raises:
            ProgramLeft: it has ended.
            FederateError: its deadline has passed.
        """
        calls, size = 0, 0
        try:
            self._stream.send(Go(now_ns, self.position, list(self._received)))
            self._received.clear()
            while (message := self._stream.receive()) is not None:
                word = up(message)
                if isinstance(word, Wait):
                    self._wait(now_ns, word)
                    return
                messages.append(self._checked(word))
                calls, size = calls + 1, size + len(messages[-1].body)
                if calls > MOST_CALLS or size > MOST_BYTES:
                    raise ProgramLeft("it sends without end and lets no time go on")
        except WireError as error:
            raise ProgramLeft(f"it said what makes no sense: {plain(str(error))}") from None
        except TimeoutError:
            late = f"has not gone on within {self._deadline_s:g} s (sockets.deadline_s)"
            raise FederateError(f"the program of {self.vehicle}", f"{late}; it hangs, or needs more time") from None
        except OSError:
            pass  # the same as an orderly end
        raise ProgramLeft("it has ended")

    def stirs(self) -> ProgramLeft:
        """Reason to dismiss a program that is active out of turn."""
        try:
            self._stream.socket.settimeout(0.0)
            return ProgramLeft("it spoke out of its turn" if self._stream.socket.recv(1) else "it has ended")
        except OSError:
            return ProgramLeft("it has ended")

    def farewell(self) -> None:
        """Send the end of the run, unless the program does not read."""
        with contextlib.suppress(OSError):
            self._stream.socket.settimeout(0.0)
            self._stream.send(Over())
            self._stream.socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """End the connection."""
        self._stream.socket.close()

    def _wait(self, now_ns: int, word: Wait) -> None:
        if self._stream.frames:
            raise ProgramLeft("it spoke out of its turn")
        self.wake_ns = None if word.for_ns is None else now_ns + word.for_ns
        self._wakes_on_reception, self._room = word.hears, ROOM - word.held

    def _checked(self, word: Up) -> Message:
        if not isinstance(word, Send):
            raise WireError("it has come already")
        if word.to is not None and word.to not in self._others:
            raise WireError(f"'{word.to}' is not another vehicle of this run")
        return Message(sender=self.vehicle, body=word.payload, size_bytes=len(word.payload), to=word.to)
