"""Child processes of this machine: never a fork of this process, ended together with this process, and links to them.

A link carries whole messages, and neither side ever waits for the other. It is a pair of local sockets that keep message
boundaries (``SOCK_SEQPACKET``): a message that cannot be sent at once is not sent at all, so there are no partial messages, and
a side that hangs cannot delay the other. When a process ends, the other side reads the end of the link.
"""

import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence

from vcmvsp.cosim.util.polling import readable

LONGEST = 1 << 18  # bytes of a message; the operating system accepts some 200 kB

PATHS = "VCMVSP_CHILD_PATHS"  # variable of a child's environment
BOOT = """
import atexit, gc, json, os, sys
atexit.register(gc.freeze)
sys.path[:] = json.loads(os.environ.pop("{paths}"))
from {module} import main
sys.exit(main())
"""


class ChildProcess:
    """A child process. It imports modules from this process's paths only, not from the current folder.

    Its standard input closes when this process ends, and it exits then. Its own process group keeps Ctrl-C away from it.

    Args:
        stdout: descriptor of its standard output; default: standard error, apart from the run's own output.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self,
        module: str,  # module with the ``main`` to call
        *arguments: str,
        first: str = "",  # first text on its standard input
        files: Sequence[int] = (),
        stdin: int = subprocess.PIPE,  # descriptor of its standard input; default: a pipe
        stdout: int | None = None,
    ) -> None:
        output = sys.__stderr__ if stdout is None else stdout
        command = [sys.executable, "-P", "-c", BOOT.format(module=module, paths=PATHS), *arguments]
        environment = {**os.environ, PATHS: json.dumps(sys.path)}
        environment["OPENBLAS_NUM_THREADS"] = "1"  # agents compute with one; more cost a fifth of the start
        self._process = subprocess.Popen(command, stdin=stdin, stdout=output, env=environment, pass_fds=files, process_group=0)
        self._tell(first)

    def _tell(self, text: str) -> None:
        """Write to the standard input of the process, if that is a pipe."""
        if self._process.stdin:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(text.encode())
                self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code; None: the process still runs."""
        return self._process.poll()

    def why_ended(self, seconds: float = 0.0) -> str:
        """How the process ended, in words; empty: it still runs after ``seconds``."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return ending(self._process.wait(seconds))
        return ""

    def wait(self) -> int:
        """Wait until the process ends; returns its exit code."""
        return self._process.wait()

    def kill(self) -> None:
        """Kill the process, without waiting."""
        self._process.kill()

    def close(self, seconds: float) -> bool:
        """Let the process exit within ``seconds``, else kill it; returns whether it exited by itself."""
        if self._process.stdin:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self.why_ended(seconds):
            return True
        with contextlib.suppress(PermissionError):  # a process with more rights ends by itself, with its pipe
            self._process.kill()
            self._process.wait()
        return False


class LinkedProcess(ChildProcess):
    """``python -m MODULE FD ARGUMENTS``: a process beside the run; FD is the other end of its `link`, which it inherits."""

    def __init__(self, module: str, *arguments: str) -> None:
        self.link, child_end = pair()
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        with child_end:
            # Own session: Ctrl-C and a closing terminal do not reach it, so it can release its resources in order.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(child_end.fileno()), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sys.__stderr__,
                env=environment,
                pass_fds=(child_end.fileno(),),
                start_new_session=True,
            )


class LocalLink:
    """One end of a link between processes."""

    def __init__(self, end: socket.socket) -> None:
        self._socket, self.ended = end, False
        end.setblocking(False)

    def fileno(self) -> int:
        """The descriptor for select."""
        return self._socket.fileno()

    def send(self, message: bytes) -> bool:
        """Send a message; returns False if the other side has stopped reading or has ended.

        Raises:
            ValueError: the message is longer than the longest possible one.
        """
        try:
            self._socket.send(message)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            return False
        except OSError as error:
            if error.errno != errno.EMSGSIZE:
                raise
            raise ValueError(f"a message of {len(message)} bytes is too long for the link") from None
        return True

    def receive(self) -> list[bytes]:
        """All messages that have arrived. Raises `ValueError` (one was longer than `LONGEST`, and is cut)."""
        messages = []
        while not self.ended:
            try:
                message, _, flags, _ = self._socket.recvmsg(LONGEST)
            except BlockingIOError:
                break
            except ConnectionResetError:  # the other side left messages unread; reported once, before its last ones
                continue
            if flags & socket.MSG_TRUNC:
                raise ValueError(f"a message was longer than {LONGEST} bytes")
            if message:
                messages.append(message)
            else:
                self.ended = True  # the other side has ended; its last messages were received
        return messages

    def wait(self, seconds: float) -> None:
        """Wait until a message arrives, at most ``seconds``."""
        readable([self._socket.fileno()], max(seconds, 0.0))

    def close(self) -> None:
        """Close this end; the other side reads the end of the link."""
        self._socket.close()


def pair() -> tuple[LocalLink, socket.socket]:
    """A link, and the socket that a child process inherits as its other end."""
    own_end, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LocalLink(own_end), child_end


def ending(code: int) -> str:
    """How a process ended, in words."""
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
