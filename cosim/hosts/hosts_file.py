"""The file that says which machines host a run's agents, for ``vcmvsp launch``.

::

    connect = "tls/192.168.1.10:7447"

    [[host]]
    ssh = "anna@laptop"
    vehicles = ["car2", "car3"]
    copy = true
"""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.types import Name
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml

HERE = (sys.executable, "-P", "-m", "vcmvsp.cosim.cli.app")


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
            connect: endpoint to dial.
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
