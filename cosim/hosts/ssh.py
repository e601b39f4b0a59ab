"""A host of agents on another machine, through the user's own ssh: started, listened to, and ended with this process.

The only command that the other machine is given is ``sh``; what to do there comes as a script on its standard input. So no
login shell, whichever it is, reads a name or a value of ours, and a certificate is on nobody's command line. Behind the script
the standard input stays open for as long as this process lives. When it closes, because the run is over, because this process
was killed or because the connection broke, the other machine ends the host, and removes what it was sent.
"""

import contextlib
import re
import shlex
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

from vcmvsp.cosim.processes.child_process import ending

CONNECT_S = 10  # for ssh to reach a machine
ALIVE_S, ALIVE_COUNT = 5, 3  # a machine that does not answer so often is given up
KILL_S = 2  # from asking a host to leave to making it
SHOWN_LINES = 3  # of a log, in a message
NOT_FOUND, SSH_FAILED = 127, 255  # exit codes: of sh, that there is no such command; of ssh itself
_LONGEST_LINE = 2**16
_HOME = re.compile(r"(~(?:[A-Za-z_][A-Za-z0-9_.-]*)?)(/|$)")
_END_OF_KEYS = "END_OF_KEYS"


def ssh(destination: str, options: Sequence[str] = ()) -> list[str]:
    """The command that runs ``sh`` on another machine: it never asks, and uses no terminal.

    Args:
        destination: what ssh takes: ``anna@laptop``, or a name of ``~/.ssh/config``.
        options: of ssh, before our own, so that they win.
    """
    ours = [f"ConnectTimeout={CONNECT_S}", f"ServerAliveInterval={ALIVE_S}", f"ServerAliveCountMax={ALIVE_COUNT}"]
    # A connection that others share would outlive this process, and keep its end of the pipe; one that is there may be used.
    ours += ["ControlMaster=no", "RemoteCommand=none"]
    defaults = [word for each in ours for word in ("-o", each)]
    return ["ssh", "-T", "-o", "BatchMode=yes", *options, *defaults, "--", destination, "sh"]


def script(
    command: Sequence[str],
    options: Sequence[str],
    *,
    last: Sequence[str] = (),
    folder: str = "",
    keys: str = "",
    bundle: str = "",
    secret: str = "",
    name: str = "host",
) -> str:
    """What ``sh`` (POSIX) is to do: run a command until it ends or the standard input closes, and end as it did.

    Args:
        command: a program, and arguments before all others; a ``~`` in front of a word means home there.
        options: of the command, taken as they are.
        last: arguments that are no options.
        folder: to go to first.
        keys: file there, for ``--keys``.
        bundle: or its content, which is sent; the file then exists as long as the command runs, and nobody else can read it.
        secret: the same for ``--secret``; not both.
        name: of that file.
    """
    lines = ["export PYTHONUNBUFFERED=1"]  # what agents print is heard at once, and not lost when they are killed
    words = [*map(path, command), *map(shlex.quote, options)]
    if bundle or secret:
        file = f'"$vault"/{shlex.quote(name)}.keys'
        lines += [
            "vault=$(umask 077 && mktemp -d) || exit 1",
            """trap 'rm -rf -- "$vault"' EXIT""",
            "trap 'exit 129' HUP INT TERM",
        ]
        lines += [f"(umask 077 && cat >{file}) <<'{_END_OF_KEYS}'", (bundle or secret).rstrip("\n"), _END_OF_KEYS]
        words += ["--keys" if bundle else "--secret", file]
    if folder:
        lines += [f"cd -- {path(folder)} || exit 1"]
    if keys:
        words += ["--keys", path(keys)]
    words += ["--", *map(shlex.quote, last)]
    # In braces: sh has read it all before it begins, so that nobody but the watcher reads the standard input afterwards.
    # Where there is setsid, the host is a group of its own, and whatever the command has started ends with it.
    # Its output is one stream: ssh has a channel for stdout and one for stderr, and lines of the two would arrive in pieces.
    return "\n".join(["{", *lines, _RUN.format(words=" ".join(words), kill_s=KILL_S), "}", ""])


_RUN = """\
exec 3<&0
group=$(command -v setsid)
$group {words} </dev/null 3<&- 2>&1 &
agent=$!
tell_all() {{ kill -s "$1" -- "-$agent" 2>/dev/null; }}
tell() {{ tell_all "$1" || kill -s "$1" "$agent"; }}
(while read -r _; do :; done; tell TERM; sleep {kill_s}; tell KILL) <&3 3<&- >/dev/null 2>&1 &
watcher=$!
exec 3<&-
wait "$agent" 2>/dev/null
code=$?
kill "$watcher" 2>/dev/null
tell_all TERM && sleep {kill_s} && tell_all KILL
exit $code"""


def path(text: str) -> str:
    """The word of a shell that means this path, with a ``~`` or ``~name`` in front expanded, and nothing else."""
    home = _HOME.match(text)
    if home is None:
        return shlex.quote(text)
    rest = text[home.end() :]
    return home[0] + (shlex.quote(rest) if rest else "")


class Far:
    """A script that runs elsewhere, and what it says.

    Args:
        command: what runs ``sh`` there; see `ssh`.
        script: for it; see `script`.
        log: takes all that is said.
        hear: takes each line of it, and in the end how it ended, if that was not well. Called in a thread.
        folder: where the command is run on this machine.
    """

    def __init__(
        self, command: Sequence[str], script: str, log: BinaryIO, hear: Callable[[str], None], folder: Path | None = None
    ) -> None:
        self._log, self._hear = log, hear
        self.last: deque[str] = deque(maxlen=SHOWN_LINES)
        self._released = False
        # A session of its own: neither Ctrl-C nor the terminal are for it.
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, cwd=folder, start_new_session=True
        )
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        with contextlib.suppress(OSError):  # it may have ended already
            if self._process.stdin:
                self._process.stdin.write(script.encode())
                self._process.stdin.flush()

    @property
    def code(self) -> int | None:
        """Its exit code, once all is heard that it said; None: it has not ended."""
        code = self._process.poll()
        if code is not None:
            self._listener.join(1.0)  # what it has started may still hold the pipe
        return code

    def release(self) -> None:
        """Have it end, if it has not by itself."""
        self._released = True
        with contextlib.suppress(OSError):
            if self._process.stdin:
                self._process.stdin.close()

    def wait(self, seconds: float) -> bool:
        """Whether it has ended within so long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self.code is not None

    def kill(self) -> None:
        """End the near end; the far one then ends by itself."""
        self._process.kill()
        self._process.wait()

    def _listen(self) -> None:
        said = self._process.stdout
        while said and (line := said.readline(_LONGEST_LINE)):
            with contextlib.suppress(ValueError):  # the log is closed by now: something that outlives its end still talks
                self._log.write(line)
            text = line.decode(errors="replace").rstrip()
            if text:
                self.last.append(text)
            self._hear(text)
        if said:
            said.close()
        code = self._process.wait()
        if code and not self._released:
            self._hear(ending(code))
