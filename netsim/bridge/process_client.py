"""The run's side of the bridge process; sending and reading never block the run."""

import time
from collections import deque
from typing import ClassVar

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.processes.child_process import LinkedProcess
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge import messages

MODULE = "vcmvsp.netsim.bridge"
READY_S = 60.0  # for all gateways to open
CLOSE_S = 10.0  # for all to close,
VEHICLE_S = 0.05  # and more for each vehicle
DYING_S = 2.0  # from the end of the link to that of the process
PAUSE_S = 0.02
MOST_OUTBOX = 256 * 2**20  # bytes for a process that does not read
ADVICE = "see its messages above, and start the run again"


class BridgeClient:
    """Handle of the bridge process: `start`, `wait_ready`, `send` and `read`, `leave`, `close`; ``killed``: it had to be."""

    _prepared: ClassVar[LinkedProcess | None] = None

    def __init__(self, process: LinkedProcess, opening: messages.Opening) -> None:
        self._process, self._link, self.killed = process, process.link, False
        self._close_s = CLOSE_S + VEHICLE_S * len(opening.vehicles)
        self._outbox: deque[bytes] = deque()
        self._outbox_bytes = 0
        self._inbox: list[messages.Up] = []
        self._leaving = self._closed = False

    @classmethod
    def prepare(cls) -> None:
        """Start the process for the next `start` now, while this process still has root's rights."""
        cls._prepared = LinkedProcess(MODULE, messages.WARY)

    @classmethod
    def start(cls, opening: messages.Opening) -> "BridgeClient":
        """Start the process, which opens all gateways; does not wait for it."""
        process, BridgeClient._prepared = cls._prepared or LinkedProcess(MODULE), None
        client = cls(process, opening)
        client.send(opening)
        return client

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def has_outbox(self) -> bool:
        """Whether messages wait until the process reads."""
        return bool(self._outbox)

    def fileno(self) -> int:
        """For select: readable when the process has sent a message or has ended."""
        return self._link.fileno()

    def wait_ready(self) -> tuple[str, ...]:
        """Wait until all gateways are open; returns lines that tell the user their addresses.

        Raises:
            FederateError: a gateway cannot be opened, or the process has ended.
        """
        until = time.monotonic() + READY_S
        received: list[messages.Up] = []
        while (remaining_s := until - time.monotonic()) > 0.0:
            self._link.wait(remaining_s)
            received += self.read()
            for message in received:
                if isinstance(message, messages.Ready):
                    self._inbox = [each for each in received if each is not message]
                    return message.lines
        raise FederateError("bridge", f"its gateways did not open within {READY_S:g} s; {ADVICE}")

    def send(self, message: messages.Down) -> None:
        """Send a message, in order, as soon as the process reads.

        Raises:
            FederateError: more than `MOST_OUTBOX` bytes wait.
        """
        data = encode(message)
        self._outbox.append(data)
        self._outbox_bytes += len(data)
        self.send_outbox()
        if self._outbox_bytes > MOST_OUTBOX:
            raise FederateError("bridge", f"its process (pid {self.pid}) no longer reads its messages; {ADVICE}")

    def send_outbox(self) -> None:
        """Send waiting messages, as far as the process reads."""
        while self._outbox and self._link.send(self._outbox[0]):
            self._outbox_bytes -= len(self._outbox.popleft())

    def read(self) -> list[messages.Up]:
        """New messages, without waiting. Raises `FederateError` (the process has failed, or has ended before `leave`)."""
        self._inbox += [messages.ups.decode(message) for message in self._link.receive()]
        problem = next((each.problem for each in self._inbox if isinstance(each, messages.BridgeFailed)), "")
        if not problem and self._link.ended and not self._leaving:
            problem = f"its process {self._process.why_ended(DYING_S) or 'closed its link'}: programs are cut off; {ADVICE}"
        if problem:
            raise FederateError("bridge", problem)
        received, self._inbox = self._inbox, []
        return received

    def leave(self) -> None:
        """Ask the process to close all gateways and to end, without waiting."""
        if not self._leaving:
            self._leaving = True
            self._outbox.clear()  # pending deliveries are dropped
            self._outbox.append(encode(messages.Leave()))
        self.send_outbox()

    def close(self) -> list[messages.Up]:
        """End the process, by force after a timeout; returns its last messages and never raises."""
        if self._closed:
            return []
        self._closed = True
        until = time.monotonic() + self._close_s
        while not self._link.ended and (remaining_s := until - time.monotonic()) > 0.0:
            self.leave()
            self._link.wait(min(PAUSE_S, remaining_s) if self._outbox else remaining_s)
            self._inbox += [messages.ups.decode(message) for message in self._link.receive()]
        self.killed = not self._process.close(DYING_S if self._link.ended else 0.0)
        self._link.close()
        return self._inbox
