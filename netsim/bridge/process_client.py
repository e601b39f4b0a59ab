"""The run's side of the bridge process: nothing that is said to it, or that it says, holds up the run.

::

    process = Beside.start(opening)
    lines = process.wait_ready()
    ... process.say(...), process.read() ...
    process.leave()
    last = process.close()
"""

import contextlib
import subprocess
import time
from collections import deque
from typing import ClassVar

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.processes.child_process import ending, linked
from vcmvsp.cosim.processes.local_link import Link
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge.process import messages

MODULE = "vcmvsp.netsim.bridge"
READY_S = 60.0  # for all doors to open
CLOSE_S = 10.0  # for all to close,
VEHICLE_S = 0.05  # and more for each vehicle
DYING_S = 2.0  # from the end of the link to that of the process
PAUSE_S = 0.02
MOST_UNSAID = 256 * 2**20  # bytes for a process that does not read
ADVICE = "look at what it says above, and start the run again"


class Beside:
    """The process; see `start`.

    Attributes:
        killed: it had to be made to end.
    """

    _prepared: ClassVar["tuple[subprocess.Popen[bytes], Link] | None"] = None

    def __init__(self, process: subprocess.Popen[bytes], end: Link, opening: messages.Opening) -> None:
        self._process, self._link, self.killed = process, end, False
        self._close_s = CLOSE_S + VEHICLE_S * len(opening.vehicles)
        self._unsaid: deque[bytes] = deque()
        self._unsaid_bytes = 0
        self._heard: list[messages.Up] = []
        self._leaving = self._closed = False

    @classmethod
    def prepare(cls) -> None:
        """Start the process for the next `start`, with rights that this process is about to give up."""
        cls._prepared = linked(MODULE, messages.WARY)

    @classmethod
    def start(cls, opening: messages.Opening) -> "Beside":
        """Start the process, which opens all doors; this does not wait for it."""
        made, Beside._prepared = cls._prepared or linked(MODULE), None
        beside = cls(*made, opening)
        beside.say(opening)
        return beside

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def unsaid(self) -> bool:
        """Whether there is more to say than it has read."""
        return bool(self._unsaid)

    def fileno(self) -> int:
        """For select: readable when it has said something, or has gone."""
        return self._link.fileno()

    def wait_ready(self) -> tuple[str, ...]:
        """Wait until all doors are open: lines that tell the user where they are.

        Raises:
            FederateError: one of them cannot be opened; the process has ended.
        """
        until = time.monotonic() + READY_S
        heard: list[messages.Up] = []
        while (left_s := until - time.monotonic()) > 0.0:
            self._link.wait(left_s)
            heard += self.read()
            for message in heard:
                if isinstance(message, messages.Ready):
                    self._heard = [each for each in heard if each is not message]  # programs are quick
                    return message.lines
        raise FederateError("bridge", f"its doors were not open after {READY_S:g} s; {ADVICE}")

    def say(self, message: messages.Down) -> None:
        """Say something, in order, as soon as it reads.

        Raises:
            FederateError: it has not read for long.
        """
        data = encode(message)
        self._unsaid.append(data)
        self._unsaid_bytes += len(data)
        self.go_on()
        if self._unsaid_bytes > MOST_UNSAID:
            raise FederateError("bridge", f"its process (pid {self.pid}) does not read any more; {ADVICE}")

    def go_on(self) -> None:
        """Say what could not be said at once, as far as it reads."""
        while self._unsaid and self._link.send(self._unsaid[0]):
            self._unsaid_bytes -= len(self._unsaid.popleft())

    def read(self) -> list[messages.Up]:
        """What has come since the last call, without waiting.

        Raises:
            FederateError: it failed, or has gone though nobody asked it to.
        """
        self._heard += [messages.ups.decode(message) for message in self._link.receive()]
        problem = next((each.problem for each in self._heard if isinstance(each, messages.Failed)), "")
        if not problem and self._link.ended and not self._leaving:
            problem = f"its process {self._how_it_ended()}: programs are cut off; {ADVICE}"
        if problem:
            raise FederateError("bridge", problem)
        heard, self._heard = self._heard, []
        return heard

    def leave(self) -> None:
        """Ask it to close all doors and to end, without waiting."""
        if not self._leaving:
            self._leaving = True
            self._unsaid.clear()  # nothing is to be delivered any more
            self._unsaid.append(encode(messages.Leave()))
        self.go_on()

    def close(self) -> list[messages.Up]:
        """Have it end, and wait for that; then make it. Its last words; never raises."""
        if self._closed:
            return []
        self._closed = True
        until = time.monotonic() + self._close_s
        while not self._link.ended and (left_s := until - time.monotonic()) > 0.0:
            self.leave()
            self._link.wait(min(PAUSE_S, left_s) if self._unsaid else left_s)
            self._heard += [messages.ups.decode(message) for message in self._link.receive()]
        try:
            self._process.wait(DYING_S if self._link.ended else 0.0)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(PermissionError):  # it ends by itself, with the link
                self._process.kill()
                self._process.wait()
            self.killed = True
        self._link.close()
        return self._heard

    def _how_it_ended(self) -> str:
        """How a process whose link has ended did so."""
        try:
            return ending(self._process.wait(DYING_S))
        except subprocess.TimeoutExpired:
            return "has hung up"
