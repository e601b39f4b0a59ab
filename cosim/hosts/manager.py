"""Start and supervision of agent hosts: in this process, in child processes, or started elsewhere."""

import contextlib
import functools
import secrets
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from vcmvsp.cosim.agent import Agent, AgentInfo, AgentSpec
from vcmvsp.cosim.config.builtin_kinds import KINDS
from vcmvsp.cosim.config.source_code import difference, fingerprint
from vcmvsp.cosim.errors import AgentError, ScenarioError
from vcmvsp.cosim.federate import Federate
from vcmvsp.cosim.hosts import listener
from vcmvsp.cosim.hosts.listener import Entrance, cut_deadline_s, indispensable, knocking, patience_s, telling_of
from vcmvsp.cosim.hosts.protocol import Built, Machine
from vcmvsp.cosim.hosts.remote_host import Crew, RemoteHost, SessionLink
from vcmvsp.cosim.scenario.schema import AgentsTable
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.event_publisher import Topics
    from vcmvsp.cosim.hosts.host_client import BuildsHost, HostFederate
    from vcmvsp.cosim.hosts.hub import ZenohLink
    from vcmvsp.cosim.processes.child_process import ChildProcess

HOST_PROCESS = "vcmvsp.agents.host_process"
LEAVE_S = 0.3  # s, for a child to exit by itself before it is killed; its agents are closed by then


class Hosts:
    """All agent hosts of a run; closing it releases processes and sockets.

    Args:
        kinds: agent classes that are objects and replace the scenario's, by vehicle.
        watch: polled while the run waits for hosts; returns a reason to give up. None: the user starts the hosts.
    """

    def __init__(
        self,
        agents: AgentsTable,
        builders: "Mapping[str, BuildsHost]",  # make the federates of agents in this process, by placement
        *,
        tell: Tell,
        kinds: Mapping[str, str] | None = None,
        listen: str | None = None,  # endpoint for hosts and observers, instead of ``agents.listen``
        keys: Path | None = None,  # folder with the certificates of hosts and observers
        insecure: bool = False,
        watch: Callable[[], str | None] | None = None,
        about: Mapping[str, Any] | None = None,  # description of the run for observers (`cosim.hosts.event_publisher.About`)
    ) -> None:
        self._about = {**(about or {}), "missing": self._absent}
        self._agents = agents if listen is None else msgspec.structs.replace(agents, listen=listen)
        self._builders, self._observed = builders, listen is not None
        self._tell, self._keys, self._insecure, self._watch = tell, keys, insecure, watch
        self._stack = contextlib.ExitStack()
        self.entrance: Entrance | None = None  # listener for remote hosts and observers
        self.federates: list[Federate] = []
        self.infos: list[AgentInfo] = []
        self.kinds = dict(kinds or {})  # vehicle -> class that replaces the scenario's, given by the caller or by a host
        self._links: list[tuple[str, ZenohLink]] = []
        self._elsewhere: list[RemoteHost] = []  # federates whose hosts may be replaced
        self._specs: dict[str, AgentSpec] = {}  # their agents as the hosts describe them
        self._spec_of: dict[str, AgentSpec] = {}  # their agents as the scenario describes them
        self._other_code: dict[str, str] = {}  # difference between the code of a vehicle's host and that of this machine
        self._waiting: dict[str, AgentSpec] = {}  # agents whose hosts had not joined when the run began

    def close(self) -> None:
        """Release all hosts."""
        self._stack.close()

    @property
    def cuts_s(self) -> dict[str, list[float]]:
        """Durations for which the run waited for an unreachable host (s), by the host's vehicles."""
        cuts: dict[str, list[float]] = {}
        for vehicles, link in self._links:
            if link.cuts_s:
                cuts.setdefault(vehicles, []).extend(link.cuts_s)
        return cuts

    @property
    def forged(self) -> dict[str, int]:
        """Number of dropped answers that another session gave in place of a host, by the host's vehicles."""
        return {vehicles: link.forged for vehicles, link in self._links if link.forged}

    @property
    def unrepeatable(self) -> list[str]:
        """Events in hosts that a repetition of the run does not reproduce."""
        events = [f"the host of {vehicle} ran different code: {how}" for vehicle, how in sorted(self._other_code.items())]
        for host in self.federates:
            for vehicles, time_s, cause in host.losses if isinstance(host, RemoteHost) else ():
                events.append(f"the host of {vehicles} was lost at {time_s:g} s: {cause}")
        return events

    def start(self, specs: Mapping[str, Sequence[AgentSpec]], objects: Mapping[str, Agent]) -> None:
        """Start the hosts of all agents, or wait for them.

        Args:
            specs: the agents by placement: ``process``, ``zenoh``, or one of the builders'.
            objects: agents that exist already, by vehicle.
        """
        outside = {"process": self.run_in_processes, "zenoh": self.await_by_hand}
        names = {"inprocess": "agents", "driven": "caller"}
        for where, group in sorted(specs.items()):
            if where in outside:
                outside[where](group)
            else:
                self._add(self._builders[where](names.get(where, where), group, objects))
        if self._observed and self.entrance is None:
            endpoint = self.listen().hub.endpoint
            nobody = 'no agent has runs = "zenoh" (--agents zenoh), so the run waits for no host'
            self._tell(f"{endpoint} serves vcmvsp watch only: {nobody}")

    @property
    def topics(self) -> "Topics | None":
        """Publisher of events for observers on other machines; None: the run does not listen."""
        return None if self.entrance is None else self.entrance.topics

    def listen(self, specs: Sequence[AgentSpec] = ()) -> Entrance:
        """Listen for the hosts of these agents and for observers."""
        self.entrance = Entrance(self._agents, specs, self._tell, keys=self._keys, insecure=self._insecure, about=self._about)
        self._stack.callback(self.entrance.close)
        return self.entrance

    def run_in_processes(self, specs: Sequence[AgentSpec]) -> None:
        """Spawn child processes, distribute the agents over them in order, and wait until all have joined."""
        from vcmvsp.cosim.hosts.hub import Hub, LinkCallbacks
        from vcmvsp.cosim.processes.fork_server import ForkServer

        count = min(self._agents.processes or len(specs), len(specs))
        groups = {secrets.token_hex(16): specs[start::count] for start in range(count)}
        patient_s, cut_s = patience_s(self._agents, specs), cut_deadline_s(self._agents)
        # No port: no other user of this machine can delay the hub, question the children or answer for them.
        hub = Hub(None, patience_s=patient_s, cut_deadline_s=cut_s, hosts=count)
        self._stack.callback(hub.close)
        modules = {KINDS["agent"][spec.kind].partition(":")[0] for spec in specs if spec.kind in KINDS["agent"]}
        server = self._stack.enter_context(ForkServer(HOST_PROCESS, *sorted(modules), files=hub.files))
        children: dict[str, ChildProcess] = {}
        for token, group in groups.items():
            vehicles = (f"--vehicle={spec.vehicle}" for spec in group)
            children[token] = server.start("--connect", hub.endpoint, *vehicles, first=f"{token}\n")
            self._stack.callback(children[token].close, LEAVE_S)
        links: dict[str, ZenohLink] = {}
        for knock in knocking(hub, self._agents.join_timeout_s, lambda: _missing(groups, links, children), self._tell):
            token = knock.hello.token
            if token not in groups or token in links:
                knock.answer("this run starts its own hosts")
                continue
            child = children[token]
            if link := knock.answer(None, LinkCallbacks(why_lost=child.why_ended, released=functools.partial(_release, child))):
                links[token] = link
        hub.shut()
        self._add_remote([(links[token], group) for token, group in groups.items()])

    def await_by_hand(self, specs: Sequence[AgentSpec]) -> None:
        """Wait until externally started hosts have joined for all agents that the run cannot begin without."""
        entrance, spec_of = self.listen(specs), {spec.vehicle: spec for spec in specs}
        hub, waiting = entrance.hub, dict(spec_of)
        self._waiting = waiting
        if self._watch is None:  # the user starts the hosts
            entrance.tell_how(specs)
        joined: dict[Machine, tuple[ZenohLink, list[AgentSpec]]] = {}

        def give_up(hosts: Collection[Machine]) -> None:
            for host in sorted(hosts):
                for spec in joined.pop(host)[1]:
                    waiting[spec.vehicle] = spec_of[spec.vehicle]
                    self.kinds.pop(spec.vehicle, None)
                    self._tell(f"the host of {spec.vehicle} disconnected; waiting for another")

        def missing() -> list[str]:
            last = time.monotonic() - self._agents.deadline_s  # hosts unreachable since before then are given up
            unreachable = {host: since for host, since in list(hub.gone.items()) if host in joined}
            give_up({host for host, since in unreachable.items() if since < last})
            if self._watch is not None and (why := self._watch()):
                raise AgentError(tuple(waiting), "host", why)
            return [*waiting, *(spec.vehicle for host in unreachable if host in joined for spec in joined[host][1])]

        timeout_s, needed = self._agents.join_timeout_s, lambda vehicle: indispensable(spec_of[vehicle])
        for knock in knocking(hub, timeout_s, missing, self._tell, needed):
            hello = knock.hello
            # A replacement need not wait until an unreachable host is given up.
            away = [(host, spec.vehicle) for host in hub.gone.keys() & joined.keys() for spec in joined[host][1]]
            give_up({host for host, vehicle in away if vehicle in hello.vehicles})
            if link := entrance.let_in(knock, listener.refusal(hello, waiting, spec_of)):
                specs_of = [listener.as_host_says(waiting.pop(vehicle), hello, self.kinds) for vehicle in hello.vehicles]
                joined[knock.machine] = link, specs_of
                self._tell(f"{', '.join(hello.vehicles)} joined; still waiting for: {', '.join(waiting) or 'none'}")
        self._waiting, self._spec_of = {}, spec_of
        self._specs = {**spec_of, **{spec.vehicle: spec for _, group in joined.values() for spec in group}}
        if not waiting:
            hub.shut()
        self._add_remote(list(joined.values()), list(waiting.values()))

    # --- hosts that have joined -----------------------------------------------------------------------------------------------

    def _add_remote(self, joined: Sequence[tuple["ZenohLink", Sequence[AgentSpec]]], late: Sequence[AgentSpec] = ()) -> None:
        crews = []
        for link, specs in joined:
            self._stack.callback(link.close)
            crews.append(self._crew_at(link, specs))
        for crew in crews:
            try:
                with telling_of(crew.vehicles, self._tell):
                    built = crew.build()
                self._add_host([crew], built)
            except (AgentError, ScenarioError) as error:
                asked_for = [self._spec_of.get(vehicle) for vehicle in crew.vehicles]
                if not all(spec is not None and not indispensable(spec) for spec in asked_for):
                    for each in crews:
                        each.release(f"the run cannot start: {error}")
                    raise
                self._tell(f"{error}; the run starts without it")
                crew.dismiss(str(error))
                late = [*late, *(spec for spec in asked_for if spec is not None)]
                for vehicle in crew.vehicles:
                    self.kinds.pop(vehicle, None)
                    self._specs[vehicle] = self._spec_of[vehicle]
        if late:  # the scenario names the classes, so the agents can be described without their host
            local = self._builders["inprocess"]("late", late)
            self._add_host([], Built(local.agents, local.reads, local.latest), late)

    def _add_host(self, crews: Sequence[Crew], built: Built, missing: Sequence[AgentSpec] = ()) -> None:
        name = f"agents-{len(self.federates)}"
        host = RemoteHost(name, crews, [built], missing=missing, door=self._answer_door, tell=self._tell)
        if self.entrance is not None:
            self._elsewhere.append(host)
        self._add(host)

    def _crew(self, link: SessionLink, specs: Sequence[AgentSpec]) -> Crew:
        timeouts = {"deadline_s": self._agents.deadline_s, "build_s": self._agents.join_timeout_s}
        return Crew(link, specs, **timeouts, on_built=self._compare_code)

    def _crew_at(self, link: "ZenohLink", specs: Sequence[AgentSpec]) -> Crew:
        vehicles = ", ".join(spec.vehicle for spec in specs)
        self._links.append((vehicles, link))
        return self._crew(link, specs)

    def _compare_code(self, built: Built) -> None:
        """Report where an external host runs other source code than this machine has."""
        for vehicle, code in built.code.items():
            if (spec := self._spec_of.get(vehicle)) is None:
                continue
            own = spec if vehicle not in self.kinds else msgspec.structs.replace(spec, kind=self.kinds[vehicle])
            how = difference(fingerprint(own), code)
            if how and self._other_code.get(vehicle) != how:
                self._other_code[vehicle] = how
                self._tell(f"the code at the host of {vehicle} differs from this machine's: {how}")

    def _add(self, host: "HostFederate") -> None:
        self.federates.append(host)
        self.infos.extend(host.agents)

    def _absent(self) -> list[str]:
        """Vehicles without an agent at the moment; called by Zenoh's thread, too."""
        return list(dict.fromkeys((*self._waiting, *self._lost())))

    def _lost(self) -> list[str]:
        return list(filter(self._accepts_host_for, list(self._specs)))

    def _accepts_host_for(self, vehicle: str) -> bool:
        return any(each.accepts_host_for(vehicle) for each in list(self._elsewhere))

    def _answer_door(self) -> None:
        if self.entrance is None:
            return
        hub, lost = self.entrance.hub, self._lost()
        if lost:
            hub.open()
        else:
            hub.shut()
        if knock := hub.next_hello(0.0):  # one a tick, so that join requests cannot stall the run
            hello = knock.hello
            places = [each for each in self._elsewhere if all(map(each.accepts_host_for, hello.vehicles))]
            link = self.entrance.let_in(knock, listener.late_refusal(hello, self._specs, lost, together=bool(places)))
            if link is not None:
                self._tell(f"{', '.join(hello.vehicles)} joined")
                # The same class may lie in another folder on the host's machine.
                changes = {} if hello.kind is None else {"kind": hello.kind, "folder": hello.folder}
                specs = [msgspec.structs.replace(self._specs[vehicle], **changes) for vehicle in hello.vehicles]
                places[0].welcome(self._crew_at(link, specs))


def _release(child: "ChildProcess", answered: bool) -> None:
    """Kill a host that does not answer. The others exit by themselves, all at once, while the run goes on to its files."""
    if not answered:
        child.kill()


def _missing(groups: Mapping[str, Sequence[AgentSpec]], links: Mapping[str, Any], children: Mapping[str, Any]) -> list[str]:
    """Vehicles whose child process has not joined yet; an `AgentError` if one has ended."""
    for token, group in groups.items():
        if token not in links and children[token].why_ended():
            cause = f"its process {children[token].why_ended()} before it joined"
            raise AgentError(tuple(spec.vehicle for spec in group), group[0].kind, cause)
    return [spec.vehicle for token, group in groups.items() if token not in links for spec in group]
