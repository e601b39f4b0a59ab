"""Hosts that ``vcmvsp launch`` starts: the file that names their machines, and each started through the user's own ssh.

::

    connect = "tls/192.168.1.10:7447"

    [[host]]
    ssh = "anna@laptop"
    vehicles = ["car2", "car3"]
    copy = true

The only command that the other machine is given is ``sh``; what to do there comes as a script on its standard input. So no
login shell, whichever it is, reads a name or a value of ours, and a certificate is on nobody's command line. Behind the script
the standard input stays open for as long as this process lives. When it closes, because the run is over, because this process
was killed or because the connection broke, the other machine ends the host, and removes what it was sent.
"""

import contextlib
import re
import shlex
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import tomli_w

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.processes.child_process import ending
from vcmvsp.cosim.types import Name
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml

HERE = (sys.executable, "-P", "-m", "vcmvsp.cosim.cli.app")

CONNECT_S = 10  # for ssh to reach a machine
ALIVE_S, ALIVE_COUNT = 5, 3  # a machine that does not answer so often is given up
KILL_S = 2  # from asking a host to leave to making it
SHOWN_LINES = 3  # of a log, in a message
NOT_FOUND, SSH_FAILED = 127, 255  # exit codes: of sh, that there is no such command; of ssh itself
_LONGEST_LINE = 2**16
_HOME = re.compile(r"(~(?:[A-Za-z_][A-Za-z0-9_.-]*)?)(/|$)")
_END_OF_KEYS = "END_OF_KEYS"


class HostTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``[[host]]``. Its paths are of its own machine and, on this one, relative to the file."""

    vehicles: tuple[Name, ...]  # whose agents it runs
    ssh: str = ""  # what ssh takes, e.g. "anna@laptop"; "": a process of this machine
    name: Name | None = None  # of its log and certificate; default: the machine's, or its first vehicle's
    ssh_options: tuple[str, ...] = ()  # e.g. ["-p", "2222"]
    connect: str | None = None  # where it dials this machine; default: the file's
    agent: str | None = None  # MODULE_OR_FILE:Class; default: the scenario's
    set: Mapping[str, Any] = {}  # parameters of the agent, instead of the scenario's
    command: str | tuple[str, ...] | None = None  # vcmvsp there, or the words that run it; default: vcmvsp
    folder: str = ""  # to go to first
    keys: str = ""  # file of keys on that machine
    copy: bool = False  # send it one, which is gone after the run

    @property
    def called(self) -> str:
        """Its name."""
        machine = re.sub(r"^ssh://|:\d+$", "", self.ssh).rpartition("@")[2]
        return self.name or re.sub(r"[^A-Za-z0-9_-]+", "-", machine).strip("-")[:64] or self.vehicles[0]

    @property
    def where(self) -> str:
        """Name and machine, for messages."""
        return f"host {self.called}" + (f" (ssh {self.ssh})" if self.ssh else "")

    @property
    def words(self) -> tuple[str, ...]:
        """The words that run vcmvsp on its machine."""
        if self.command is None:
            return ("vcmvsp",) if self.ssh else HERE
        return (self.command,) if isinstance(self.command, str) else self.command

    def arguments(self, connect: str, code: Sequence[str], *, insecure: bool) -> list[str]:
        """What vcmvsp is told there, but for keys.

        Args:
            code: options that name the classes which it may run (`cosim.config.registry.host_options`).
            insecure: dial without a certificate.
        """
        words = ["agent", *(f"--vehicle={vehicle}" for vehicle in self.vehicles), f"--connect={connect}", *code]
        words += [f"--set={key}={toml(value)}" for key, value in self.set.items()]
        words += ["--insecure"] if insecure else []
        return words


class HostsTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file of hosts."""

    host: tuple[HostTable, ...]
    connect: str | None = None  # where hosts dial this machine, e.g. "tls/192.168.1.10:7447"; default: where the run listens


def read(path: Path) -> HostsTable:
    """Read and check a file of hosts.

    Raises:
        ScenarioError: naming file, line and key, and what is allowed.
        UsageError: it cannot be read.
    """
    try:
        text = limits.read_text(path)
        raw = read_toml(text)
    except OSError as error:
        raise UsageError(f"--hosts {path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ScenarioError(f"is not valid TOML: {error}", source=str(path)) from error
    lines = Source(str(path), path.parent, text)
    listed = binding.call(HostsTable, raw, origin=lines)
    if not listed.host:
        raise ScenarioError("needs at least one [[host]]", source=str(path))
    names: dict[str, int] = {}
    hosted: dict[str, str] = {}
    for number, host in enumerate(listed.host):
        if fault := _fault(host, names, hosted):
            key = f"host[{number}].{fault[0]}"
            raise ScenarioError(fault[1], key=key, source=lines.of(key))
        names[host.called] = number
        hosted |= dict.fromkeys(host.vehicles, host.called)
    return listed


def _fault(host: HostTable, names: Mapping[str, int], hosted: Mapping[str, str]) -> tuple[str, str] | None:
    """Key and problem of a host that types cannot say, given the ones before it."""
    if not host.vehicles or len({*host.vehicles}) < len(host.vehicles):
        return "vehicles", "must name at least one vehicle, and none twice"
    if taken := [vehicle for vehicle in host.vehicles if vehicle in hosted]:
        return "vehicles", f"'{taken[0]}' has a host already, '{hosted[taken[0]]}'"
    if host.called in names:
        return "name", f"host[{names[host.called]}] is called '{host.called}' too: give them names that differ"
    if host.ssh.startswith("-") or re.search(r"\s", host.ssh):
        return "ssh", f"must be a destination that ssh takes, e.g. 'anna@laptop', not {binding.show(host.ssh)}"
    if host.keys and host.copy:
        return "keys", "is a file that is there already; copy sends one: leave one of them out"
    if not host.words or not host.words[0]:
        return "command", "must name a program"
    return None


def toml(value: object) -> str:
    """A value as ``--set`` reads it, in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_scalar(str(key))} = {toml(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return _scalar(value)


def _scalar(value: object) -> str:
    return tomli_w.dumps({"v": value}).removeprefix("v = ").rstrip("\n")


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
    command: Sequence[str],  # a program, and arguments before all others; a ``~`` in front of a word means home there
    options: Sequence[str],
    *,
    last: Sequence[str] = (),  # arguments that are no options
    folder: str = "",  # to go to first
    keys: str = "",  # file there, for ``--keys``
    bundle: str = "",
    secret: str = "",  # the same for ``--secret``; not both
    name: str = "host",
) -> str:
    """What ``sh`` (POSIX) is to do: run a command until it ends or the standard input closes, and end as it did.

    Args:
        bundle: or its content, which is sent; the file then exists as long as the command runs, and nobody else can read it.
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
