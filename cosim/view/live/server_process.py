"""A view of a run, as the run has it: a process that serves the page, and the feed to it."""

import contextlib
import json
import subprocess
import sys
import time
from types import TracebackType
from typing import Self

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.processes.child_process import BOOT, ending
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view import HOST
from vcmvsp.cosim.view.auth.rules import new_token, url_of
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import Feed
from vcmvsp.cosim.view.live.newest_values import Places, Poses
from vcmvsp.cosim.view.messages import Scenery

START_S = 60.0  # for the page to be there
LEAVE_S = 3.0  # for the process to leave by itself
MODULE = "vcmvsp.cosim.view.live.server_main"


class Viewer:
    """The page of a run. Use it as a context manager, or `close` it: leaving it ends the process that serves the page."""

    def __init__(self, process: "subprocess.Popen[bytes]", pipe: protocol.Pipe, url: str, feed: Feed) -> None:
        self._process, self._pipe, self.url, self.feed = process, pipe, url, feed

    @classmethod
    def open(
        cls,
        scenery: Scenery,
        host: str = HOST,
        *,
        port: int,
        token: str | None = None,
        moving: Poses | None = None,
        targets: Places | None = None,
    ) -> Self:
        """Start the process, and wait for the page.

        Args:
            scenery: what is shown all the time.
            host: what the page is served on.
            port: likewise; 0: any that is free.
            token: what those who look must bring; default: a new one.
            moving: where obstacles are that keep to a time-table (`Feed`).
            targets: where targets lie, likewise.

        Raises:
            UsageError: the page cannot be served there, or its process does not start.
        """
        token = token or new_token()
        pipe, theirs = protocol.pair()
        with theirs:
            process = _started(theirs.fileno())
        try:
            port = _up(process, pipe, protocol.Start(scenery=scenery, host=host, port=port, token=token)).port
        except BaseException:
            _end(process, pipe)
            raise
        return cls(process, pipe, url_of(host, port, token), Feed(pipe, scenery, moving=moving, targets=targets))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def stay(self) -> None:
        """Wait until the process ends or Ctrl-C is pressed: the page can be looked at although the run is over."""
        with contextlib.suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        """End the process. May be called again."""
        _end(self._process, self._pipe)


def _started(descriptor: int) -> "subprocess.Popen[bytes]":
    """The process; it looks for modules where this one does, Ctrl-C does not reach it, and its output is not the run's."""
    command = [sys.executable, "-P", "-c", BOOT.format(module=MODULE), str(descriptor)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.__stderr__, pass_fds=(descriptor,), process_group=0)
    with contextlib.suppress(BrokenPipeError), process.stdin or contextlib.nullcontext():
        if process.stdin:
            process.stdin.write(f"{json.dumps(sys.path)}\n".encode())
    return process


def _up(process: "subprocess.Popen[bytes]", pipe: protocol.Pipe, start: protocol.Start) -> protocol.Up:
    """Tell the process what to show, and wait until it does."""
    until_s = time.monotonic() + START_S
    pipe.offer_within(codec.encode(start), START_S)
    while (left_s := until_s - time.monotonic()) > 0.0:
        for message in pipe.take(wait_s=min(left_s, 0.2)):
            answer = protocol.answers.decode(message)
            if isinstance(answer, protocol.Up):
                return answer
            if isinstance(answer, protocol.Down):
                raise UsageError(answer.problem)
        if not pipe.open:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(LEAVE_S)
            code = process.poll()
            raise UsageError(
                f"the process of the view {'has gone' if code is None else ending(code)} before its page was there"
            )
    raise UsageError(f"the page of the view was not there within {START_S:g} s")


def _end(process: "subprocess.Popen[bytes]", pipe: protocol.Pipe) -> None:
    pipe.close()
    try:
        process.wait(LEAVE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
