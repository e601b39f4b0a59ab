"""Child processes forked from one that has imported their modules: a hundred of them start in the time of one.

A fork has only the thread that calls it, and locks that other threads hold stay locked in it. So the run, which has threads,
is never forked: it starts one child afresh, which imports modules, has a single thread, and forks itself on request.
(`multiprocessing.forkserver` does so, too, but each child would run the user's script again.)
"""

import contextlib
import gc
import importlib
import json
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Sequence
from typing import IO, cast

from vcmvsp.cosim.processes.child_process import ChildProcess
from vcmvsp.cosim.util.polling import readable

MODULE = "vcmvsp.cosim.processes.fork_server"
FORKS = sys.platform == "linux"  # libraries of macOS do not survive a fork
LONG_S = 3600.0
NUMBER = struct.Struct("q")  # in a request: the size of the arguments; in a report


class ForkServer:
    """Starts child processes that call the ``main`` of a module: forks of one process that has imported the module.

    Use it as a context manager: entering it starts that process, leaving it loses the exit codes of its forks. Threads may
    share it. Where `FORKS` is false, it starts each process afresh.

    Args:
        imports: further modules that the child processes need. No module here may start a thread when it is imported, unless
            the thread is prepared for forks, as that of pyarrow's allocator.
        files: descriptors that the child processes inherit.
        stdout: as of `ChildProcess`.
    """

    def __init__(self, module: str, *imports: str, files: Sequence[int] = (), stdout: int | None = None) -> None:
        self._module, self._imports, self._files, self._stdout = module, imports, files, stdout
        self._lock = threading.Lock()
        self._open = contextlib.ExitStack()

    def __enter__(self) -> "ForkServer":
        if not FORKS:
            return self
        with contextlib.ExitStack() as opened:
            self._requests, child_end = socket.socketpair()
            opened.enter_context(self._requests)
            arguments = self._module, *self._imports
            with child_end:
                self._process = ChildProcess(
                    MODULE, *arguments, files=self._files, stdin=child_end.fileno(), stdout=self._stdout
                )
            opened.callback(self._process.wait)
            opened.callback(self._process.kill)
            self._open = opened.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def start(self, *arguments: str, first: str = "", stdin: int = subprocess.PIPE) -> ChildProcess:
        """Start a child process; arguments and errors as of `ChildProcess`."""
        if not FORKS:
            return ChildProcess(self._module, *arguments, first=first, files=self._files, stdin=stdin, stdout=self._stdout)
        with self._lock:
            with contextlib.suppress(BrokenPipeError):  # the server was killed just now
                if self._process.returncode is None:  # else, a fork may still hold the server's end of the requests
                    return ForkedProcess(self._requests, self._process, arguments, first, stdin)
            self._open.close()
            self.__enter__()
            return ForkedProcess(self._requests, self._process, arguments, first, stdin)


class ForkedProcess(ChildProcess):
    """A child process that the fork server at the other end of ``requests`` forks."""

    def __init__(self, requests: socket.socket, server: ChildProcess, arguments: Sequence[str], first: str, stdin: int) -> None:
        self._process = cast("subprocess.Popen[bytes]", _Fork(requests, server, json.dumps(arguments).encode(), stdin))
        self._tell(first)


class _Fork:
    """The part of `subprocess.Popen` that `ChildProcess` uses, from the server's report: process id, then exit code."""

    def __init__(self, requests: socket.socket, server: ChildProcess, arguments: bytes, stdin: int) -> None:
        self._server, self._lock = server, threading.Lock()
        self._pid: int | None = None
        self._code: int | None = None
        with contextlib.ExitStack() as child_ends, contextlib.ExitStack() as own_ends:
            self._report, report = os.pipe()
            child_ends.callback(os.close, report)
            own_ends.callback(os.close, self._report)
            self.stdin: IO[bytes] | None = None
            if stdin == subprocess.PIPE:
                stdin, own = os.pipe()
                child_ends.callback(os.close, stdin)
                self.stdin = own_ends.enter_context(os.fdopen(own, "wb"))
            socket.send_fds(requests, [NUMBER.pack(len(arguments))], [stdin, report])
            requests.sendall(arguments)
            own_ends.pop_all()
        # Open for as long as this object: a thread may wait for the report while another one reads its end.
        weakref.finalize(self, os.close, self._report)

    @property
    def pid(self) -> int:
        """The process id, as soon as the server has started; 0: it never will."""
        with self._lock:
            if self._pid is None:
                self._read()
            return self._pid or 0

    def poll(self) -> int | None:
        """The exit code; None: the process still runs."""
        with self._lock:
            while self._code is None and readable([self._report], 0.0):
                self._read()
            return self._code

    def wait(self, timeout: float | None = None) -> int:
        """The exit code when the process has ended. Raises `subprocess.TimeoutExpired` (it still runs after ``timeout`` s)."""
        last = time.monotonic() + (math.inf if timeout is None else timeout)
        while (code := self.poll()) is None:
            left_s = last - time.monotonic()
            if left_s <= 0.0:
                raise subprocess.TimeoutExpired(MODULE, timeout or 0.0)
            readable([self._report], min(left_s, LONG_S))
        return code

    def kill(self) -> None:
        """Kill the process if it still runs."""
        if self.pid and self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has ended just now
                os.kill(self.pid, signal.SIGKILL)

    def _read(self) -> None:
        """Read the next number of the report. If the server ends first, its end counts as that of the fork."""
        number = os.read(self._report, NUMBER.size)
        if not number:
            self._pid, self._code = self._pid or 0, self._server.wait()
        elif self._pid is None:
            self._pid = NUMBER.unpack(number)[0]
        else:
            self._code = NUMBER.unpack(number)[0]


# --- server process -------------------------------------------------------------------------------------------------------


def main() -> int:
    """Entry point of a fork server, which returns in its forks only."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run to handle, which ends its children
    requests = socket.socket(fileno=os.dup(0))
    gc.disable()  # of the many objects of imports, none is in a cycle that ends
    module = importlib.import_module(sys.argv[1])
    for name in sys.argv[2:]:
        importlib.import_module(name)
    gc.freeze()  # a collection in a fork would copy the memory that it shares
    gc.enable()
    reports: dict[int, int] = {}  # by the process id of a fork that runs
    ends, wakes = os.pipe()
    os.set_blocking(wakes, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
    while True:
        ready = readable([requests.fileno(), ends], LONG_S)
        if ends in ready:
            os.read(ends, select.PIPE_BUF)
            _report_ends(reports)
        if requests.fileno() in ready:
            size, files, _, _ = socket.recv_fds(requests, NUMBER.size, 2)
            if not size:
                os._exit(0)  # its parent has ended
            arguments = requests.recv(NUMBER.unpack(size)[0], socket.MSG_WAITALL)
            stdin, report = files
            if (pid := os.fork()) == 0:
                break
            os.write(report, NUMBER.pack(pid))
            reports[pid] = report
            os.close(stdin)
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.dup2(stdin, 0)
    for descriptor in (stdin, report, ends, wakes, *reports.values()):
        os.close(descriptor)
    requests.close()
    if "numpy.random" in sys.modules:
        sys.modules["numpy.random"].seed()  # as in a process that is started afresh
    os.setpgid(0, 0)
    sys.argv[1:] = json.loads(arguments)
    code: int = module.main()
    return code


def _report_ends(reports: dict[int, int]) -> None:
    with contextlib.suppress(ChildProcessError):  # none is left
        while (end := os.waitpid(-1, os.WNOHANG))[0]:
            report = reports.pop(end[0])
            os.write(report, NUMBER.pack(os.waitstatus_to_exitcode(end[1])))
            os.close(report)
