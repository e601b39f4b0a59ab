"""Where machines dial in to a run: hosts of agents that somebody starts, and those who only watch."""

import contextlib
import queue
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.errors import AgentError, UsageError
from vcmvsp.cosim.scenario.schema import AgentsTable
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.host_link import ZenohLink
    from vcmvsp.cosim.hosts.hub import Hub, Knock
    from vcmvsp.cosim.security.certificates import Keys

POLL_S = 0.05
SAY_S = 5.0  # who is awaited is said so often
GONE_S = 10.0  # a host that is out of reach for so long while it is to build its agents is given up
MOST_TOLD = 100  # different reasons for which hosts were refused


class Entrance:
    """Listens, and tells the user who is refused; closing it lets nobody in any more.

    Args:
        agents: the scenario's ``[agents]``.
        specs: the agents whose hosts come this way; none: it is for those who watch.
        tell: takes lines for the user.
        keys: folder with the certificates of those who may come; None: whoever can reach it.
        insecure: let anybody come from other machines.
        about: of the run, for those who watch (`cosim.hosts.event_publisher.About`).

    Attributes:
        hub: the run's end of the network.
        topics: what those see who watch.

    Raises:
        UsageError: nobody may listen there, or a vehicle has no certificate.
    """

    def __init__(
        self,
        agents: AgentsTable,
        specs: Sequence[AgentSpec],
        tell: Tell,
        *,
        keys: Path | None,
        insecure: bool,
        about: Mapping[str, Any],
    ) -> None:
        from vcmvsp.cosim.hosts.event_publisher import Topics
        from vcmvsp.cosim.hosts.hub import Hub
        from vcmvsp.cosim.transport import local_secret

        self._tell, self._keys, self._insecure = tell, keys, insecure
        self._news: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # of Zenoh's threads, for the user
        self._refused: set[str] = set()  # what has been said of those who were refused
        self._certified, listen = self._certificates(agents.listen, specs)
        with contextlib.ExitStack() as stack:
            secret = None if self._certified or insecure else local_secret.made()
            wait_s, cut_s = patience_s(agents, specs), cut_deadline_s(agents)
            self.hub = Hub(listen, self._certified, secret=secret, patience_s=wait_s, cut_deadline_s=cut_s)
            stack.callback(self.hub.close)
            if secret:
                stack.enter_context(local_secret.published(self.hub.endpoint, secret))
            elif not self._certified:
                tell(f"caution: whoever can reach {self.hub.endpoint} can host agents of this run and watch it (--insecure)")
            self.topics = Topics(self.hub.session, about, self._certified)
            stack.callback(self.topics.close)
            threading.Thread(target=self._tell_news, daemon=True).start()
            stack.callback(self._news.put, None)
            if not specs:
                self.hub.shut()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Let go of the network."""
        self._stack.close()

    def note(self, text: str) -> None:
        """Tell the user something, from a thread that has no time to wait until it is told."""
        self._news.put(text)

    def tell_how(self, specs: Sequence[AgentSpec]) -> None:
        """Tell how to start a host for each of these agents."""
        self._tell(f"waiting for {len(specs)} agents at {self.hub.endpoint}; start each with")
        for spec in specs:
            how = ["--vehicle", spec.vehicle, "--connect", self.hub.endpoint]
            how += (
                ["--keys", self._certified.file_of(spec.vehicle)]
                if self._certified
                else ["--insecure"]
                if self._insecure
                else []
            )
            how += registry.host_options([spec.kind, spec.params, spec.defaults], spec.folder)
            self._tell(shlex.join(["vcmvsp", "agent", spec.kind or "MODULE_OR_FILE:Class", *how]))

    def let_in(self, knock: "Knock", refusal: str | None) -> "ZenohLink | None":
        """A link to a host that knocks, unless it is refused; why is told to it and, once, to the user."""
        if why := knock.denied or refusal:
            words = f"refused a host{f' with the certificate of {knock.machine[0]}' if self._keys else ''}: {why}"
            if words not in self._refused and len(self._refused) < MOST_TOLD:
                self._refused.add(words)
                self._tell(words)
        from vcmvsp.cosim.hosts.host_link import LinkCallbacks

        who = ", ".join(knock.hello.vehicles)

        def noticed(there: bool) -> None:
            self.note(f"the host of {who} is {'back' if there else 'out of reach'}")

        def forged() -> None:
            self.note(f"another session answers in place of the host of {who}: its answers are dropped and counted")

        return knock.answer(refusal, LinkCallbacks(noticed=noticed, forged=forged))

    def _tell_news(self) -> None:
        """Tell what has happened as it happens, however long that takes: Zenoh's threads have other things to do."""
        while (text := self._news.get()) is not None:
            self._tell(text)

    def _certificates(self, listen: str, specs: Sequence[AgentSpec]) -> "tuple[Keys | None, str]":
        """What the user says of who may come from elsewhere, and where to, checked."""
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
    timeout_s: float,
    missing: Callable[[], Sequence[str]],
    tell: Tell,
    indispensable: Callable[[str], bool] = lambda _: True,
) -> "Iterator[Knock]":
    """Hosts that want to join, until nobody is missing.

    Args:
        hub: where they knock.
        timeout_s: when it is too late, from now on.
        missing: whose hosts have not joined yet, asked again and again.
        tell: takes lines for the user.
        indispensable: whether the run cannot begin without this vehicle's agent.

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
