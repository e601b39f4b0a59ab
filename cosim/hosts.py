"""Where agents run: in this process, in child processes, or in hosts that somebody starts elsewhere."""

import contextlib
import os
import secrets
import shlex
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from cosim import registry, table
from cosim.agent import Agent, AgentInfo, AgentSpec
from cosim.errors import AgentError, UsageError, VcmvspError
from cosim.federate import Federate
from cosim.scenario import AgentsTable
from cosim.transport.remote import Desk, HostFederate, Link, MemoryLink, RemoteHost
from cosim.transport.wire import Hello

if TYPE_CHECKING:
    from cosim.certificates import Keys
    from cosim.transport.zenoh import Hub, Knock, ZenohLink

HOST_PROCESS = "agents.serve"
POLL_S = 0.05


class Tell(Protocol):
    """Takes a line for the user."""

    def __call__(self, text: str) -> None:
        """Show it."""


class Hosts:
    """All hosts of a run; closing it lets go of processes and sockets.

    Args:
        agents: the scenario's ``[agents]``.
        tell: takes lines for the user, such as how to start a host by hand.
        keys: folder with the certificates of those who may come from elsewhere.
        insecure: let anybody come from elsewhere.
    """

    def __init__(self, agents: AgentsTable, tell: Tell, *, keys: Path | None = None, insecure: bool = False) -> None:
        self._agents, self._tell, self._keys, self._insecure = agents, tell, keys, insecure
        self._stack = contextlib.ExitStack()
        self.federates: list[Federate] = []
        self.infos: list[AgentInfo] = []
        self.kinds: dict[str, str] = {}  # vehicle -> class that a host brought along instead of the scenario's

    def close(self) -> None:
        """Let go of them all."""
        self._stack.close()

    def run_here(self, specs: Sequence[AgentSpec], objects: Mapping[str, Agent]) -> None:
        """Host agents in this process."""
        builder: Callable[..., HostFederate] = registry.piece("agent host")
        self._add(builder("agents", specs, objects))

    def run_encoded(self, specs: Sequence[AgentSpec]) -> None:
        """Host agents in this process, but behind the same bytes as over a wire (for tests of the wire)."""
        desk = Desk(registry.piece("agent host"))
        self._stack.callback(desk.close)
        host = self._remote("agents", MemoryLink(desk.handle), specs)
        host.build()
        self._add(host)

    def run_in_processes(self, specs: Sequence[AgentSpec]) -> None:
        """Spawn hosts, deal the agents out to them in order, and wait until all have joined."""
        from cosim.transport.process import HostProcess
        from cosim.transport.zenoh import Hub

        hub = Hub(deadline_s=self._agents.deadline_s)
        self._stack.callback(hub.close)
        count = min(self._agents.processes or len(specs), len(specs))
        groups = {secrets.token_hex(16): specs[start::count] for start in range(count)}
        children: dict[str, HostProcess] = {}
        for token, group in groups.items():
            children[token] = HostProcess(HOST_PROCESS, hub.endpoint, [spec.vehicle for spec in group], token)
            self._stack.callback(children[token].close)
        links: dict[str, ZenohLink] = {}
        for knock in self._knocking(hub, lambda: self._missing(groups, links, children)):
            token = knock.hello.token
            if link := knock.answer(None if token in groups and token not in links else "this run starts its own hosts"):
                link.why_lost = children[token].why_ended
                link.released = children[token].close
                links[token] = link
        self._add_remote((links[token], group) for token, group in groups.items())

    def await_by_hand(self, specs: Sequence[AgentSpec]) -> None:
        """Wait until hosts that somebody starts have joined for all these agents."""
        from cosim.transport.zenoh import Hub

        keys = self._certificates(specs)
        hub = Hub(self._agents.listen, keys, deadline_s=self._agents.deadline_s)
        self._stack.callback(hub.close)
        wanted = {spec.vehicle: spec for spec in specs}
        waiting = dict(wanted)
        self._tell(f"waiting for {len(waiting)} agents at {hub.endpoint}; start each with")
        for spec in specs:
            how = ["--vehicle", spec.vehicle, "--connect", hub.endpoint]
            how += ["--keys", f"{spec.vehicle}.keys"] if keys else ["--insecure"] if self._insecure else []
            self._tell(shlex.join(["vcmvsp", "agent", spec.kind or "MODULE_OR_FILE:Class", *how]))
        joined: dict[str, tuple[ZenohLink, list[AgentSpec]]] = {}

        def missing() -> list[str]:
            for host in sorted(hub.gone & joined.keys()):
                for left in joined.pop(host)[1]:
                    waiting[left.vehicle] = wanted[left.vehicle]
                    self.kinds.pop(left.vehicle, None)
                    self._tell(f"the host of {left.vehicle} has left; waiting for another")
            return list(waiting)

        for knock in self._knocking(hub, missing):
            hello = knock.hello
            refusal = knock.denied or _refusal(hello, waiting, wanted)
            if refusal:
                self._tell(f"refused a host{f' with the certificate of {knock.name}' if keys else ''}: {refusal}")
            if link := knock.answer(refusal):
                joined[hello.host] = link, [self._as_host_says(waiting.pop(vehicle), hello) for vehicle in hello.vehicles]
                self._tell(f"{', '.join(hello.vehicles)} joined; still waiting for: {', '.join(waiting) or 'none'}")
        self._add_remote(joined.values())

    def _certificates(self, specs: Sequence[AgentSpec]) -> "Keys | None":
        """What the user says of who may come from elsewhere, checked."""
        from cosim.transport.security import endpoint_rules

        keys = None
        if self._keys is not None:
            from cosim import certificates

            keys = certificates.load(self._keys)
            if warning := keys.check():
                self._tell(warning)
        endpoint_rules(self._agents.listen, keys, insecure=self._insecure)
        if keys and (lacking := keys.lacking([spec.vehicle for spec in specs])):
            command = f"vcmvsp keys vehicle {lacking[0]} --keys {self._keys}"
            raise UsageError(f"no machine has a certificate for {', '.join(lacking)}: {command}")
        return keys

    def _add_remote(self, joined: Iterable[tuple[Link, Sequence[AgentSpec]]]) -> None:
        hosts = []
        for number, (link, specs) in enumerate(joined, len(self.federates)):
            self._stack.callback(link.close)
            hosts.append(self._remote(f"agents-{number}", link, specs))
        for host in hosts:
            host.build()
            self._add(host)

    def _remote(self, name: str, link: Link, specs: Sequence[AgentSpec]) -> RemoteHost:
        return RemoteHost(name, link, specs, deadline_s=self._agents.deadline_s, build_s=self._agents.join_timeout_s)

    def _add(self, host: HostFederate) -> None:
        self.federates.append(host)
        self.infos.extend(host.agents)

    def _knocking(self, hub: "Hub", missing: Callable[[], Sequence[str]]) -> "Iterator[Knock]":
        """Hosts that want to join, until nobody is missing; too late is an error that names who is."""
        last = time.monotonic() + self._agents.join_timeout_s
        while vehicles := missing():
            if time.monotonic() > last:
                cause = f"did not join within {self._agents.join_timeout_s:g} s (agents.join_timeout_s)"
                raise AgentError(tuple(vehicles), "host", cause)
            if knock := hub.next_hello(POLL_S):
                yield knock
        hub.shut()

    @staticmethod
    def _missing(groups: Mapping[str, Sequence[AgentSpec]], links: Mapping[str, Any], children: Mapping[str, Any]) -> list[str]:
        """Vehicles whose child has not joined yet; a child that has ended never will."""
        for token, group in groups.items():
            if token not in links and not children[token].running:
                cause = f"its process {children[token].why_ended()} before it joined"
                raise AgentError(tuple(spec.vehicle for spec in group), group[0].kind, cause)
        return [spec.vehicle for token, group in groups.items() if token not in links for spec in group]

    def _as_host_says(self, spec: AgentSpec, hello: Hello) -> AgentSpec:
        """The spec with what the host was told on its own command line."""
        params: dict[str, Any] = dict(hello.params)
        if hello.kind is None or _same(hello.kind, spec.kind):
            kind, folder = (hello.kind, hello.folder) if hello.kind else (spec.kind, spec.folder)
            return msgspec.structs.replace(spec, kind=kind, folder=folder, params={**spec.params, **params})
        self.kinds[spec.vehicle] = hello.kind
        # Another class than the scenario's: the scenario's parameters are for it where it takes them.
        defaults = {**spec.defaults, **spec.params}
        return msgspec.structs.replace(spec, kind=hello.kind, folder=hello.folder, params=params, defaults=defaults)


def _refusal(hello: Hello, waiting: Mapping[str, AgentSpec], expected: Collection[str]) -> str | None:
    """Why a host that knocks may not come in; None: it may."""
    if len(set(hello.vehicles)) < len(hello.vehicles):
        return "it names a vehicle twice"
    for vehicle in hello.vehicles:
        if vehicle not in expected:
            return f"{table.unknown('vehicle', vehicle, expected)}, or its agent runs elsewhere"
        if vehicle not in waiting:
            return f"the agent of '{vehicle}' has joined already"
        if hello.kind is None and not waiting[vehicle].kind:
            return f"the scenario names no agent for '{vehicle}': start the host with MODULE_OR_FILE:Class"
    return None if hello.vehicles else "it names no vehicle"


def _same(one: str, other: str) -> bool:
    """Whether two kinds name the same class; of files only the name counts, since folders differ between machines."""
    return _target(one) == _target(other)


def _target(kind: str) -> str:
    if registry.is_file_kind(kind):
        return os.path.basename(kind)  # noqa: PTH119  of "folder/file.py:Class", which is no path
    with contextlib.suppress(VcmvspError):
        return registry.target("agent", kind)
    return kind
