"""Where machines dial in to a run: hosts of agents that somebody starts, of which some are let in, and those who only watch."""

import contextlib
import os
import queue
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
SAY_S = 5.0  # who is awaited is said so often
GONE_S = 10.0  # a host that is out of reach for so long while it is to build its agents is given up
MOST_TOLD = 100  # different reasons for which hosts were refused


def refusal(hello: Hello, waiting: Mapping[str, AgentSpec], expected: Collection[str]) -> str | None:
    """Why a host that knocks may not come in; None: it may."""
    if len(set(hello.vehicles)) < len(hello.vehicles):
        return "it names a vehicle twice"
    for vehicle in hello.vehicles:
        if vehicle not in expected:
            return f"{binding.unknown('vehicle', vehicle, expected)}, or its agent runs elsewhere"
        if vehicle not in waiting:
            return f"the agent of '{vehicle}' has joined already, or is not to come back"
        if hello.kind is None and not waiting[vehicle].kind:
            return f"the scenario names no agent for '{vehicle}': start the host with MODULE_OR_FILE:Class"
    return None if hello.vehicles else "it names no vehicle"


def late_refusal(hello: Hello, specs: Mapping[str, AgentSpec], lost: Collection[str], *, together: bool) -> str | None:
    """Why a host that comes when the run has begun may not come in; None: it may.

    Args:
        specs: the agents that are hosted elsewhere.
        lost: vehicles that may have another host.
        together: whether all that it names were at one host.
    """
    free = {vehicle: spec for vehicle, spec in specs.items() if vehicle in lost}
    if why := refusal(hello, free, specs):
        return why
    for vehicle in hello.vehicles:
        spec = specs[vehicle]
        if hello.kind is not None and _target(hello.kind) != _target(spec.kind):
            return f"the run has begun with {spec.kind} for '{vehicle}', and takes no other agent"
        if any(spec.params.get(name) != value for name, value in hello.params.items()):
            return "the run has begun, and takes no other parameters: leave out --set"
    return None if together else f"the run has begun with {', '.join(hello.vehicles)} at several hosts: start one for each"


def as_host_says(spec: AgentSpec, hello: Hello, kinds: dict[str, str]) -> AgentSpec:
    """The spec with what the host was told on its own command line; another class than the scenario's is noted in ``kinds``."""
    params: dict[str, Any] = dict(hello.params)
    if hello.kind is None or _target(hello.kind) == _target(spec.kind):
        kind, folder = (hello.kind, hello.folder) if hello.kind else (spec.kind, spec.folder)
        return msgspec.structs.replace(spec, kind=kind, folder=folder, params={**spec.params, **params})
    kinds[spec.vehicle] = hello.kind
    # Another class than the scenario's: the scenario's parameters are for it where it takes them.
    defaults = {**spec.defaults, **spec.params}
    return msgspec.structs.replace(spec, kind=hello.kind, folder=hello.folder, params=params, defaults=defaults)


def _target(kind: str) -> str:
    """The class that a kind names; of files only the name counts, since folders differ between machines."""
    if registry.is_file_kind(kind):
        return os.path.basename(kind)  # noqa: PTH119  of "folder/file.py:Class", which is no path
    with contextlib.suppress(VcmvspError):
        return registry.target("agent", kind)
    return kind


class Entrance:
    """Listens, and tells the user who is refused; closing it lets nobody in any more.

    Attributes:
        hub: the run's end of the network.

    Raises:
        UsageError: nobody may listen there, or a vehicle has no certificate.
    """

    def __init__(
        self,
        agents: AgentsTable,
        specs: Sequence[AgentSpec],  # the agents whose hosts come this way; none: it is for those who watch
        tell: Tell,
        *,
        keys: Path | None,  # folder with the certificates of those who may come; None: whoever can reach it
        insecure: bool,  # let anybody come from other machines
        about: Mapping[str, Any],
    ) -> None:
        from vcmvsp.cosim.hosts.event_publisher import Topics
        from vcmvsp.cosim.hosts.hub import Hub
        from vcmvsp.cosim.transport import endpoints

        self._tell, self._keys, self._insecure = tell, keys, insecure
        self._news: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # of Zenoh's threads, for the user
        self._refused: set[str] = set()  # what has been said of those who were refused
        self._certified, listen = self._certificates(agents.listen, specs)
        with contextlib.ExitStack() as stack:
            secret = None if self._certified or insecure else endpoints.made()
            wait_s, cut_s = patience_s(agents, specs), cut_deadline_s(agents)
            self.hub = Hub(listen, self._certified, secret=secret, patience_s=wait_s, cut_deadline_s=cut_s)
            stack.callback(self.hub.close)
            if secret:
                stack.enter_context(endpoints.published(self.hub.endpoint, secret))
            elif not self._certified:
                tell(f"caution: whoever can reach {self.hub.endpoint} can host agents of this run and watch it (--insecure)")
            self.topics = Topics(self.hub.session, about, self._certified)  # what those see who watch
            stack.callback(self.topics.close)
            threading.Thread(target=self._tell_news, daemon=True).start()
            stack.callback(self._news.put, None)
            if not specs:
                self.hub.shut()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Let go of the network."""
        self._stack.close()

    def tell_how(self, specs: Sequence[AgentSpec]) -> None:
        """Tell how to start a host for each of these agents."""
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
        """A link to a host that knocks, unless it is refused; why is told to it and, once, to the user."""
        if why := knock.denied or refusal:
            words = f"refused a host{f' with the certificate of {knock.machine[0]}' if self._keys else ''}: {why}"
            if words not in self._refused and len(self._refused) < MOST_TOLD:
                self._refused.add(words)
                self._tell(words)
        from vcmvsp.cosim.hosts.hub import LinkCallbacks

        who = ", ".join(knock.hello.vehicles)

        def noticed(there: bool) -> None:
            self._news.put(f"the host of {who} is {'back' if there else 'out of reach'}")

        def forged() -> None:
            self._news.put(f"another session answers in place of the host of {who}: its answers are dropped and counted")

        return knock.answer(refusal, LinkCallbacks(noticed=noticed, forged=forged))

    def _tell_news(self) -> None:
        """Tell what has happened as it happens, however long that takes: Zenoh's threads have other things to do."""
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
    timeout_s: float,  # when it is too late, from now on
    missing: Callable[[], Sequence[str]],  # whose hosts have not joined yet, asked again and again
    tell: Tell,
    indispensable: Callable[[str], bool] = lambda _: True,  # whether the run cannot begin without this vehicle's agent
) -> "Iterator[Knock]":
    """Hosts that want to join, until nobody is missing.

    Raises:
        AgentError: it is too late; naming those of the missing whom the run needs.
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
            tell(f"the host of {', '.join(vehicles)} {cause}; the run begins without")
            return
        if knock := hub.next_hello(POLL_S):
            yield knock


def awaited(vehicles: Sequence[str]) -> str:
    """What a user is told who sees nothing happen."""
    return f"still waiting for the host of {', '.join(vehicles)}"


@contextlib.contextmanager
def telling_of(vehicles: Sequence[str], tell: Tell) -> Iterator[None]:
    """Tell, once, who is awaited where that takes long."""
    timer = threading.Timer(SAY_S, tell, [awaited(vehicles)])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def patience_s(agents: AgentsTable, specs: Sequence[AgentSpec]) -> float:
    """For how long a host waits for a run that it is cut off from: where it may come back, it had better be there."""
    return agents.deadline_s if all(map(indispensable, specs)) else max(agents.deadline_s, agents.join_timeout_s)


def cut_deadline_s(agents: AgentsTable) -> float:
    """For how long a host may be out of reach, whatever it was asked: building its agents takes long, a step does not."""
    return max(agents.deadline_s, GONE_S)


def indispensable(spec: AgentSpec) -> bool:
    """Whether the run cannot begin without it: it must not be lost, or only its host knows what it is."""
    return spec.on_lost == "stop" or not spec.kind
