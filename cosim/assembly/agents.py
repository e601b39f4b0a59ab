"""Who the agents of a scenario are, where each of them runs, and what its host is told of it."""

import math
from collections.abc import Mapping, Sequence

from vcmvsp.cosim.agent import Agent, AgentInfo, AgentSpec
from vcmvsp.cosim.assembly.vehicles import Fleet
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import AgentsTable, AgentTable, Scenario, VehicleTable


class Placement:
    """All agents, by where they run.

    Args:
        scenario: tells of them.
        source: where it was read from.
        fleet: their vehicles.
        objects: agents that exist already, by vehicle; they run in this process. Also an attribute.
        runs: where all run, whatever the scenario says; ``"encoded"`` is in this process behind the wire's bytes, ``"here"`` in
            this process as far as the scenario names their classes. None: where the scenario says.

    Attributes:
        specs: what hosts are told of the agents, by where these run: ``inprocess``, ``encoded``, ``process`` or ``zenoh``.
        where: the same place, by vehicle.
        kinds: the classes of objects that are given instead of the scenario's, by vehicle.

    Raises:
        ScenarioError: an object is for no vehicle, or nothing says what somebody's agent is.
    """

    def __init__(
        self, scenario: Scenario, source: Source, fleet: Fleet, objects: Mapping[str, Agent], runs: str | None
    ) -> None:
        self._scenario, self._source, self._fleet, self.objects = scenario, source, fleet, objects
        names = [each.name for each in scenario.vehicle]
        if unknown := [name for name in objects if name not in names]:
            raise ScenarioError(binding.unknown("vehicle", unknown[0], names), key="agents")
        for name, each in objects.items():
            if not isinstance(each, Agent):
                made = f"a class: write {each.__name__}(...)" if isinstance(each, type) else binding.show(each)
                raise ScenarioError(f"must be an object of a class derived from vcmvsp.Agent, not {made}", key=f"agents.{name}")
        self.specs: dict[str, list[AgentSpec]] = {}
        self.where: dict[str, str] = {}
        self.kinds: dict[str, str] = {}
        for vehicle in scenario.vehicle:
            if (where := self._place(vehicle, runs)) is not None:
                self.specs.setdefault(where, []).append(self._spec(vehicle, where))
                self.where[vehicle.name] = where

    def check_defaults_taken(self, infos: Sequence[AgentInfo]) -> None:
        """Raise `ScenarioError` unless every default of ``[agents]`` is taken by some agent, as their hosts tell."""
        taken = {name for info in infos for name in info.taken}
        if any(each.agent and not each.agent.kind for each in self._scenario.vehicle):
            taken.add("kind")
        for name in self._scenario.agents.defaults:
            if name not in taken:
                key = f"agents.{name}"
                known = {each for info in infos for each in info.known}
                why = f"every agent that has it sets its own '{name}'" if name in known or name == "kind" else None
                if not infos:
                    why = "no vehicle has an agent (a vehicle gets one by an agent table, which may be empty: agent = {})"
                allowed = {*known, *binding.parameters(AgentsTable), "kind"} - {"defaults"}
                problem = f"no agent takes this default: {why or binding.unknown('key', name, allowed)}"
                raise ScenarioError(problem, key=key, source=self._source.of(key))

    def _place(self, vehicle: VehicleTable, runs: str | None) -> str | None:
        """Where a vehicle's agent runs; None: it has none, or ``here`` nobody knows what it is."""
        if vehicle.name in self.objects:
            return "inprocess"
        if vehicle.agent is None:
            return None
        where = vehicle.agent.runs or self._scenario.agents.runs
        if runs == "here":
            return None if where == "zenoh" and not self._kind(vehicle) else "inprocess"
        return runs or where

    def _kind(self, vehicle: VehicleTable) -> str:
        """The kind of a vehicle's agent, as far as the scenario says it."""
        return (vehicle.agent and vehicle.agent.kind) or self._scenario.agents.defaults.get("kind", "")

    def _spec(self, vehicle: VehicleTable, where: str) -> AgentSpec:
        from vcmvsp.physics.vehicles.specification import body_of

        agents, own = self._scenario.agents, vehicle.agent
        fate = own or AgentTable()
        kind = self._kind(vehicle)
        if vehicle.name in self.objects:
            made = type(self.objects[vehicle.name])
            key = f"vehicle.{vehicle.name}.agent.kind"
            meant = registry.target("agent", kind, key=key, origin=self._source) if kind else ""
            if meant.rpartition(":")[2] != made.__qualname__:
                self.kinds[vehicle.name] = kind = f"{made.__module__}:{made.__qualname__}"
                own = None  # what the scenario says is meant for another class
        if not kind and where != "zenoh":
            key = f"vehicle.{vehicle.name}.agent.kind"
            raise ScenarioError("is missing, and [agents] has no kind for all", key=key, source=self._source.of(key))
        defaults = {name: value for name, value in agents.defaults.items() if name != "kind"}
        params = self._source.kept(own.params, f"vehicle.{vehicle.name}.agent", ()) if own else {}
        if own and len(params) < len(own.params):  # for another class than the file's: where it takes them
            defaults |= {name: value for name, value in own.params.items() if name not in params}
        given = ((f"agents.{n}", n) for n in defaults), ((f"vehicle.{vehicle.name}.agent.{n}", n) for n in params)
        replaced = {n: names for each in given for key, n in each if (names := self._source.replaced(key)) is not None}
        latency = own.latency_s if own and own.latency_s is not None else agents.latency_s
        sensors = self._fleet.sensors[vehicle.name]
        return AgentSpec(
            vehicle=vehicle.name,
            kind=kind,
            folder=str(self._source.folder.resolve()),
            params=params,
            defaults=defaults,
            replaced=replaced,
            period_s=(own and own.period_s) or agents.period_s,
            latency_s=latency,
            source=self._source.name,
            sensors=tuple(sensors),
            beside_m={
                name: beside
                for name, each in sensors.items()
                if (beside := math.hypot(*getattr(each, "position", (0.0, 0.0))[:2])) > 0.0
            },
            body=body_of(self._fleet.models[vehicle.name]),
            fails_s=fate.fails_s,
            on_lost=fate.on_lost or agents.on_lost,
            hold_s=agents.hold_s if fate.hold_s is None else fate.hold_s,
        )
