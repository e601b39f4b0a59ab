"""Listener of a run for remote machines: admits agent hosts against the scenario, and serves observers."""

import contextlib
import os
import queue
import secrets
import shlex
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import AgentError, UsageError, VcmvspError
from vcmvsp.cosim.hosts.protocol import Hello
from vcmvsp.cosim.scenario.schema import AgentsTable
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.hub import Hub, Knock, ZenohLink
    from vcmvsp.cosim.security.certificates import Keys

POLL_S = 0.05
SAY_S = 5.0  # interval of the message about awaited hosts
GONE_S = 10.0  # a host that is unreachable for so long while it builds its agents is lost
MOST_TOLD = 100  # number of different refusals that are reported


def refusal(hello: Hello, waiting: Mapping[str, AgentSpec], expected: Collection[str]) -> str | None:
    """Reason to refuse a host before the run begins, or None to admit it."""
    if len(set(hello.vehicles)) < len(hello.vehicles):
        return "it names a vehicle twice"
    for vehicle in hello.vehicles:
        if vehicle not in expected:
            return f"{binding.unknown('vehicle', vehicle, expected)}, or its agent runs elsewhere"
        if vehicle not in waiting:
            return f"the agent of '{vehicle}' has already joined, or may not return"
        if hello.kind is None and not waiting[vehicle].kind:
            return f"the scenario names no agent for '{vehicle}': start the host with MODULE_OR_FILE:Class"
    return None if hello.vehicles else "it names no vehicle"


def late_refusal(hello: Hello, specs: Mapping[str, AgentSpec], lost: Collection[str], *, together: bool) -> str | None:
    """Reason to refuse a host during the run, or None to admit it.

    Args:
        specs: the agents that are hosted elsewhere.
        lost: vehicles that may get another host.
        together: whether all vehicles of the request were at one host.
    """
    free = {vehicle: spec for vehicle, spec in specs.items() if vehicle in lost}
    if why := refusal(hello, free, specs):
        return why
    for vehicle in hello.vehicles:
        spec = specs[vehicle]
        if hello.kind is not None and _target(hello.kind) != _target(spec.kind):
            return f"the run started with {spec.kind} for '{vehicle}' and accepts no other agent"
        if any(spec.params.get(name) != value for name, value in hello.params.items()):
            return "the run has started and accepts no other parameters: leave out --set"
    return None if together else f"the run started with {', '.join(hello.vehicles)} at several hosts: start one for each"


def as_host_says(spec: AgentSpec, hello: Hello, kinds: dict[str, str]) -> AgentSpec:
    """The agent with the options of its host's command line; a class that replaces the scenario's is noted in ``kinds``."""
    params: dict[str, Any] = dict(hello.params)
    if hello.kind is None or _target(hello.kind) == _target(spec.kind):
        kind, folder = (hello.kind, hello.folder) if hello.kind else (spec.kind, spec.folder)
        return msgspec.structs.replace(spec, kind=kind, folder=folder, params={**spec.params, **params})
    kinds[spec.vehicle] = hello.kind
    # The host's own class takes the scenario's parameters as far as it has them.
    defaults = {**spec.defaults, **spec.params}
    return msgspec.structs.replace(spec, kind=hello.kind, folder=hello.folder, params=params, defaults=defaults)


def _target(kind: str) -> str:
    """The class that a kind names; a file counts by its name, since folders differ between machines."""
    if registry.is_file_kind(kind):
        return os.path.basename(kind)  # noqa: PTH119  of "folder/file.py:Class", which is no path
    with contextlib.suppress(VcmvspError):
        return registry.target("agent", kind)
    return kind


class Entrance:
    """The listener: admits machines, and tells the user about refusals; closing it ends admission.

    Attributes:
        hub: the run's end of the network.

    Raises:
        UsageError: listening there is not allowed, or a vehicle has no certificate.
    """

    def __init__(
        self,
        agents: AgentsTable,
        specs: Sequence[AgentSpec],  # agents whose hosts dial in; none: observers only
        tell: Tell,
        *,
        keys: Path | None,  # folder with the certificates of admitted machines; None: none are required
        insecure: bool,  # accept other machines without certificates
        about: Mapping[str, Any],
    ) -> None:
        from vcmvsp.cosim.hosts.event_publisher import Topics
        from vcmvsp.cosim.hosts.hub import Hub
        from vcmvsp.cosim.transport import endpoints

        self._tell, self._keys, self._insecure = tell, keys, insecure
        self._news: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # messages of Zenoh's threads for the user
        self._refused: set[str] = set()  # refusals that have been reported
        self._certified, listen = self._certificates(agents.listen, specs)
        with contextlib.ExitStack() as stack:
            secret = None if self._certified or insecure else secrets.token_hex(16)
            wait_s, cut_s = patience_s(agents, specs), cut_deadline_s(agents)
            self.hub = Hub(listen, self._certified, secret=secret, patience_s=wait_s, cut_deadline_s=cut_s, hosts=len(specs))
            stack.callback(self.hub.close)
            if secret:
                stack.enter_context(endpoints.published(self.hub.endpoint, secret))
            elif not self._certified:
                tell(f"caution: anyone who can reach {self.hub.endpoint} can host agents of this run and watch it (--insecure)")
            self.topics = Topics(self.hub.session, about, self._certified)  # publishes the run's events to observers
            stack.callback(self.topics.close)
            threading.Thread(target=self._tell_news, daemon=True).start()
            stack.callback(self._news.put, None)
            if not specs:
                self.hub.shut()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Close the network."""
        self._stack.close()

    def tell_how(self, specs: Sequence[AgentSpec]) -> None:
        """Tell the user how to start a host for each of these agents."""
        self._tell(f"waiting for {len(specs)} agents at {self.hub.endpoint}; start each with")
        for spec in specs:
            how = ["--vehicle", spec.vehicle, "--connect", self.hub.endpoint]
            if self._certified:
                how += ["--keys", self._certified.file_of(spec.vehicle)]
            elif self._insecure:
                how += ["--insecure"]
            how += registry.host_options([spec.kind, spec.params, spec.defaults], spec.folder)
            self._tell(shlex.join(["vcmvsp", "agent", spec.kind or "MODULE_OR_FILE:Class", *how]))

    def let_in(self, knock: "Knock", refusal: str | None) -> "ZenohLink | None":
        """Admit a host (returns its link) or refuse it; the reason goes to the host and, once, to the user."""
        if why := knock.denied or refusal:
            words = f"rejected a host{f' with the certificate of {knock.machine[0]}' if self._keys else ''}: {why}"
            if words not in self._refused and len(self._refused) < MOST_TOLD:
                self._refused.add(words)
                self._tell(words)
        from vcmvsp.cosim.hosts.hub import LinkCallbacks

        vehicles = ", ".join(knock.hello.vehicles)

        def noticed(is_reachable: bool) -> None:
            self._news.put(f"the host of {vehicles} is {'back' if is_reachable else 'unreachable'}")

        def forged() -> None:
            self._news.put(f"another session answers in place of the host of {vehicles}: its answers are dropped and counted")

        return knock.answer(refusal, LinkCallbacks(noticed=noticed, forged=forged))

    def _tell_news(self) -> None:
        """Show messages as they arrive, in a thread of its own: Zenoh's threads must not wait for the user's terminal."""
        while (text := self._news.get()) is not None:
            self._tell(text)

    def _certificates(self, listen: str, specs: Sequence[AgentSpec]) -> "tuple[Keys | None, str]":
        from vcmvsp.cosim.transport.endpoints import endpoint_rules

        keys = None
        if self._keys is not None:
            from vcmvsp.cosim.security import certificates

            keys = certificates.load(self._keys)
            if warning := keys.check():
                self._tell(warning)
        listen = endpoint_rules(listen, keys, insecure=self._insecure)
        if keys and (lacking := keys.lacking([spec.vehicle for spec in specs])):
            command = f"vcmvsp keys vehicle {lacking[0]} --keys {self._keys}"
            raise UsageError(f"no machine has a certificate for {', '.join(lacking)}: {command}")
        return keys, listen


def knocking(
    hub: "Hub",
    timeout_s: float,  # wall-clock seconds until the run gives up
    missing: Callable[[], Sequence[str]],  # vehicles whose hosts have not joined yet; polled
    tell: Tell,
    indispensable: Callable[[str], bool] = lambda _: True,  # whether the run cannot begin without this vehicle's agent
) -> "Iterator[Knock]":
    """Hosts that ask to join, until no agent is missing.

    Raises:
        AgentError: time is over; names the missing agents that the run needs.
    """
    last, say = time.monotonic() + timeout_s, time.monotonic() + SAY_S
    while vehicles := missing():
        if time.monotonic() > say:
            say += SAY_S
            tell(awaited(vehicles))
        if time.monotonic() > last:
            cause = f"did not join within {timeout_s:g} s (agents.join_timeout_s)"
            if needed := tuple(filter(indispensable, vehicles)):
                raise AgentError(needed, "host", cause)
            tell(f"the host of {', '.join(vehicles)} {cause}; the run starts without it")
            return
        if knock := hub.next_hello(POLL_S):
            yield knock


def awaited(vehicles: Sequence[str]) -> str:
    """The message about hosts that have not joined yet."""
    return f"still waiting for the host of {', '.join(vehicles)}"


@contextlib.contextmanager
def telling_of(vehicles: Sequence[str], tell: Tell) -> Iterator[None]:
    """Tell the user once which hosts are awaited, if that takes long."""
    timer = threading.Timer(SAY_S, tell, [awaited(vehicles)])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def patience_s(agents: AgentsTable, specs: Sequence[AgentSpec]) -> float:
    """Reconnect timeout of a host; longer if the run may continue without it."""
    return agents.deadline_s if all(map(indispensable, specs)) else max(agents.deadline_s, agents.join_timeout_s)


def cut_deadline_s(agents: AgentsTable) -> float:
    """Longest time for which a host may be unreachable; building its agents may take longer than a step's deadline."""
    return max(agents.deadline_s, GONE_S)


def indispensable(spec: AgentSpec) -> bool:
    """Whether the run cannot begin without this agent: it must not be lost, or only its host knows its class."""
    return spec.on_lost == "stop" or not spec.kind
