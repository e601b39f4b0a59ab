"""Child processes of this machine: started afresh (never forked), ended with this one however it ends, and links to them.

A link carries whole messages, and nobody ever waits for the other side. It is a pair of local sockets that keep messages apart
(``SOCK_SEQPACKET``): what does not go at once does not go at all, so that half a message is never on its way, and a side that
hangs cannot hold the other. When a process ends, however, the other side reads the end of the link.
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

LONGEST = 1 << 18  # bytes of a message; the operating system takes some 200 kB

BOOT = """
import json, os, sys
line = b""
while not line.endswith(b"\\n"):
    line += os.read(0, 1) or sys.exit()  # its parent has died
sys.path[:] = json.loads(line)
from {module} import main
sys.exit(main())
"""


class ChildProcess:
    """One child. It looks for modules where this process does, and nowhere else: not in the current folder.

    Its standard input closes when this process ends, upon which it leaves. A group of its own keeps Ctrl-C away from it.

    Args:
        stdout: descriptor of its standard output; default: standard error, for it must not mix with the run's own output.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self,
        module: str,  # whose ``main`` it calls
        *arguments: str,
        first: str = "",  # what it reads first of its standard input
        files: Sequence[int] = (),
        stdin: int = subprocess.PIPE,  # descriptor of its standard input; default: a pipe
        stdout: int | None = None,
        boot: str = BOOT,  # the program that calls ``main``, once it has read the paths of modules
    ) -> None:
        output = sys.__stderr__ if stdout is None else stdout
        command = [sys.executable, "-P", "-c", boot.format(module=module), *arguments]
        self._process = subprocess.Popen(command, stdin=stdin, stdout=output, pass_fds=files, process_group=0)
        if self._process.stdin:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(f"{json.dumps(sys.path)}\n{first}".encode())
                self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Its number."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """How it ended; None: it has not, or nobody has looked."""
        return self._process.poll()

    def why_ended(self, seconds: float = 0.0) -> str:
        """How it ended, in words; empty: it has not, within so long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return ending(self._process.wait(seconds))
        return ""

    def wait(self) -> None:
        """Until it ends."""
        self._process.wait()

    def kill(self) -> None:
        """End it, without waiting for that."""
        self._process.kill()

    def close(self, seconds: float) -> bool:
        """Let it leave within so long, or make it; whether it left by itself."""
        if self._process.stdin:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self.why_ended(seconds):
            return True
        with contextlib.suppress(PermissionError):  # what has more rights than this process ends by itself, with its pipe
            self._process.kill()
            self._process.wait()
        return False


class LinkedProcess(ChildProcess):
    """``python -m MODULE FD ARGUMENTS``: a process beside the run; FD is the other end of its `link`, which it inherits."""

    def __init__(self, module: str, *arguments: str) -> None:
        self.link, there = pair()
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        with there:
            # A session of its own keeps away Ctrl-C, and the end of the terminal: what it holds is let go of in order first.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(there.fileno()), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sys.__stderr__,
                env=environment,
                pass_fds=(there.fileno(),),
                start_new_session=True,
            )


class LocalLink:
    """One end of a link."""

    def __init__(self, end: socket.socket) -> None:
        self._socket, self.ended = end, False
        end.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def send(self, message: bytes) -> bool:
        """Whether it went: not if the other side has stopped reading, or has gone.

        Raises:
            ValueError: it is longer than any message can be, and will never go.
        """
        try:
            self._socket.send(message)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            return False
        except OSError as error:
            if error.errno != errno.EMSGSIZE:
                raise
            raise ValueError(f"a message of {len(message)} bytes is longer than the link takes") from None
        return True

    def receive(self) -> list[bytes]:
        """All that has come. Raises `ValueError` (a message was longer than `LONGEST`, and the end of it is missing)."""
        messages = []
        while not self.ended:
            try:
                message, _, flags, _ = self._socket.recvmsg(LONGEST)
            except BlockingIOError:
                break
            except ConnectionResetError:  # it went without reading everything; it is said once, before its last words
                continue
            if flags & socket.MSG_TRUNC:
                raise ValueError(f"a message was longer than {LONGEST} bytes")
            if message:
                messages.append(message)
            else:
                self.ended = True  # the other side has gone; what it had said before was received
        return messages

    def wait(self, seconds: float) -> None:
        """Until something has come, at most so long."""
        readable([self._socket.fileno()], max(seconds, 0.0))

    def close(self) -> None:
        """Let the other side read the end of the link."""
        self._socket.close()


def pair() -> tuple[LocalLink, socket.socket]:
    """A link, and the end of it that a child process is to inherit."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LocalLink(here), there


def ending(code: int) -> str:
    """How a process ended, in words."""
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
