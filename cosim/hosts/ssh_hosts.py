"""Hosts that ``vcmvsp launch`` starts through the user's ssh, and the file that lists them.

::

    connect = "tls/192.168.1.10:7447"

    [[host]]
    ssh = "anna@laptop"
    vehicles = ["car2", "car3"]
    copy = true

The remote command is only ``sh``; a script on its standard input says what to do. So the login shell of the machine parses no
name or value, and no certificate appears on a command line. The standard input stays open for as long as this process lives.
When it closes (end of the run, death of this process, broken connection), the remote script ends the host and removes the files
that it was sent.
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

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.processes.child_process import ending
from vcmvsp.cosim.types import Name
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml, toml_line

HERE = (sys.executable, "-P", "-m", "vcmvsp.cosim.cli.app")

CONNECT_S = 10  # s, for ssh to reach a machine
ALIVE_S, ALIVE_COUNT = 5, 3  # a machine is lost after so many unanswered probes, one each 5 s
KILL_S = 2  # s, between SIGTERM and SIGKILL
SHOWN_LINES = 3  # lines of a log in a message
NOT_FOUND, SSH_FAILED = 127, 255  # exit codes: of sh for an unknown command; of ssh itself
_LONGEST_LINE = 2**16
_HOME = re.compile(r"(~(?:[A-Za-z_][A-Za-z0-9_.-]*)?)(/|$)")
_END_OF_KEYS = "END_OF_KEYS"


class HostTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ``[[host]]``. Its paths are on its own machine; without ``ssh`` they are relative to the file."""

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
        """The host's name: ``name``, or the machine's, or that of its first vehicle."""
        machine = re.sub(r"^ssh://|:\d+$", "", self.ssh).rpartition("@")[2]
        return self.name or re.sub(r"[^A-Za-z0-9_-]+", "-", machine).strip("-")[:64] or self.vehicles[0]

    @property
    def label(self) -> str:
        """Name and machine of the host, for messages."""
        return f"host {self.called}" + (f" (ssh {self.ssh})" if self.ssh else "")

    @property
    def words(self) -> tuple[str, ...]:
        """The command words that run vcmvsp on the host's machine."""
        if self.command is None:
            return ("vcmvsp",) if self.ssh else HERE
        return (self.command,) if isinstance(self.command, str) else self.command

    def arguments(self, connect: str, code: Sequence[str], *, insecure: bool) -> list[str]:
        """Arguments of vcmvsp on the host's machine, without those for keys.

        Args:
            code: options that name the classes that it may run (`cosim.config.registry.host_options`).
            insecure: dial without a certificate.
        """
        words = ["agent", *(f"--vehicle={vehicle}" for vehicle in self.vehicles), f"--connect={connect}", *code]
        words += [f"--set={key}={toml_line(value)}" for key, value in self.set.items()]
        words += ["--insecure"] if insecure else []
        return words


class HostsTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that lists hosts."""

    host: tuple[HostTable, ...]
    connect: str | None = None  # where hosts dial this machine, e.g. "tls/192.168.1.10:7447"; default: where the run listens


def read(path: Path) -> HostsTable:
    """Read and check a file that lists hosts.

    Raises:
        ScenarioError: naming file, line and key, and what is allowed.
        UsageError: the file cannot be read.
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
            raise lines.error(fault[1], f"host[{number}].{fault[0]}")
        names[host.called] = number
        hosted |= dict.fromkeys(host.vehicles, host.called)
    return listed


def _fault(host: HostTable, names: Mapping[str, int], hosted: Mapping[str, str]) -> tuple[str, str] | None:
    """Key and problem of a host that contradicts itself or earlier hosts, or None."""
    if not host.vehicles or len({*host.vehicles}) < len(host.vehicles):
        return "vehicles", "must contain at least one vehicle, each only once"
    if duplicates := [vehicle for vehicle in host.vehicles if vehicle in hosted]:
        return "vehicles", f"'{duplicates[0]}' already has a host, '{hosted[duplicates[0]]}'"
    if host.called in names:
        return "name", f"host[{names[host.called]}] is also named '{host.called}': use distinct names"
    if host.ssh.startswith("-") or re.search(r"\s", host.ssh):
        return "ssh", f"must be a destination for ssh, e.g. 'anna@laptop', not {binding.show(host.ssh)}"
    if host.keys and host.copy:
        return "keys", "names a file on the host, and copy = true sends one: leave one of them out"
    if not host.words or not host.words[0]:
        return "command", "must name a program"
    return None


def ssh(destination: str, options: Sequence[str] = ()) -> list[str]:
    """The command that runs ``sh`` on another machine without prompts and without a terminal.

    Args:
        destination: what ssh takes: ``anna@laptop``, or a name of ``~/.ssh/config``.
        options: options of ssh; they precede the built-in ones, and so take precedence.
    """
    ours = [f"ConnectTimeout={CONNECT_S}", f"ServerAliveInterval={ALIVE_S}", f"ServerAliveCountMax={ALIVE_COUNT}"]
    # A new shared connection would outlive this process and keep its end of the pipe; an existing one may be used.
    ours += ["ControlMaster=no", "RemoteCommand=none"]
    defaults = [word for each in ours for word in ("-o", each)]
    return ["ssh", "-T", "-o", "BatchMode=yes", *options, *defaults, "--", destination, "sh"]


def script(
    command: Sequence[str],  # program and its first arguments; a leading ``~`` is the remote home
    options: Sequence[str],
    *,
    last: Sequence[str] = (),  # positional arguments
    folder: str = "",  # working directory
    keys: str = "",  # remote file for ``--keys``
    bundle: str = "",
    secret: str = "",  # content for ``--secret``, instead of a bundle
    name: str = "host",
) -> str:
    """The POSIX script that runs a command until it ends or the standard input closes, and exits with its code.

    Args:
        bundle: content of a certificate file instead of ``keys``; the remote copy is private and exists while the command runs.
    """
    lines = ["export PYTHONUNBUFFERED=1"]  # output of agents arrives at once and survives a kill
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
    # In braces: sh reads all of it before it starts, so only the watcher reads the standard input afterwards.
    # With setsid the host is a process group, and all processes of the command end with it.
    # Stdout and stderr are one stream: ssh has a channel for each, and would interleave pieces of lines.
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
    """The shell word for a path; only a leading ``~`` or ``~name`` expands."""
    home = _HOME.match(text)
    if home is None:
        return shlex.quote(text)
    rest = text[home.end() :]
    return home[0] + (shlex.quote(rest) if rest else "")


class Far:
    """A remote script and its output.

    Args:
        hear: called in a thread with each line of output, and at the end with the failure, if any.
        folder: working directory of the command on this machine.
    """

    def __init__(
        self, command: Sequence[str], script: str, log: BinaryIO, hear: Callable[[str], None], folder: Path | None = None
    ) -> None:
        self._log, self._hear = log, hear
        self.last: deque[str] = deque(maxlen=SHOWN_LINES)
        self._released = False
        # Own session: neither Ctrl-C nor the terminal reaches it.
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
        """Exit code of the script, once all its output is read; None: it still runs."""
        code = self._process.poll()
        if code is not None:
            self._listener.join(1.0)  # processes that it has started may still hold the pipe
        return code

    def release(self) -> None:
        """End the remote command, if it still runs."""
        self._released = True
        with contextlib.suppress(OSError):
            if self._process.stdin:
                self._process.stdin.close()

    def wait(self, seconds: float) -> bool:
        """Whether the script ends within ``seconds``."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self.code is not None

    def kill(self) -> None:
        """Kill the local process; the remote one then ends by itself."""
        self._process.kill()
        self._process.wait()

    def _listen(self) -> None:
        output = self._process.stdout
        while output and (line := output.readline(_LONGEST_LINE)):
            with contextlib.suppress(ValueError):  # the log is closed; a process that outlives the host still writes
                self._log.write(line)
            text = line.decode(errors="replace").rstrip()
            if text:
                self.last.append(text)
            self._hear(text)
        if output:
            output.close()
        code = self._process.wait()
        if code and not self._released:
            self._hear(ending(code))
