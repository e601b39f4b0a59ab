"""The vehicles of a scenario, what each carries, and what physics is told of them; their agents, and where each agent runs."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.agent import SHOWN, Agent, AgentInfo, AgentSpec
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import AgentsTable, AgentTable, Scenario, VehicleTable

if TYPE_CHECKING:
    from vcmvsp.physics.sensors.sensor import Sensor
    from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec


TOPICS = (
    *("state", "estimate", "odometry", "fix", "command", "send", "heard", "note", "follows", "host", "real", "incident"),
    *SHOWN.values(),
)
"""Of every vehicle."""
_NOT_SHARED = {"name", "pose", "position", "agent", "driver", "localisation", "params"}
"""Keys of a vehicle for which [vehicles] has no default."""


class Fleet:
    """All vehicles, with their sensors.

    Args:
        resolution: is told what they are with everything filled in.

    Attributes:
        models: what each vehicle is, an object of the class that its kind names, by vehicle.
        sensors: what each vehicle carries, by vehicle and by the sensor's name.

    Raises:
        ScenarioError: a table of theirs is wrong, or no vehicle has what ``[vehicles]`` or ``record.sensors`` speaks of.
    """

    def __init__(self, scenario: Scenario, source: Source, resolution: Resolution) -> None:
        self._scenario, self._source, self._resolution = scenario, source, resolution
        self._classes: dict[str, type[Vehicle]] = {}  # of vehicles, by kind
        self.models: Mapping[str, Vehicle] = {each.name: self._model(each) for each in scenario.vehicle}
        self.sensors: Mapping[str, Mapping[str, Sensor]] = {each.name: self._fit(each) for each in scenario.vehicle}
        self._check_defaults_taken()
        self._check_recorded()

    def specs(self) -> "list[VehicleSpec]":
        """What physics is told of each, in the scenario's order."""
        return [self._spec(each) for each in self._scenario.vehicle]

    def recorded(self) -> set[str]:
        """The readings that are recorded, ``vehicle/sensor``."""
        kept = self._scenario.record.sensors
        return {f"{v}/{s}" for v, fitted in self.sensors.items() for s in fitted if s in kept or "*" in kept}

    def _class(self, vehicle: VehicleTable) -> "type[Vehicle]":
        """The class of a vehicle's kind, looked up once: a file is not executed again for every vehicle."""
        if vehicle.kind not in self._classes:
            key = f"vehicle.{vehicle.name}.kind"
            found = registry.find("vehicle", vehicle.kind, folder=self._source.folder, key=key, origin=self._source)
            self._classes[vehicle.kind] = found
        return self._classes[vehicle.kind]

    def _own(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The parameters of a vehicle; a default of ``[vehicles]`` counts only where the kind takes it."""
        known = binding.parameters(self._class(vehicle))
        defaults = self._scenario.vehicles
        params = self._source.kept(vehicle.params, f"vehicle.{vehicle.name}", known)
        return {n: v for n, v in params.items() if n in known or n not in defaults}

    def _model(self, vehicle: VehicleTable) -> "Vehicle":
        key, kind = f"vehicle.{vehicle.name}", self._class(vehicle)
        own, also = (
            registry.found(kind, self._own(vehicle), self._source, key),
            {*binding.parameters(VehicleTable)} - {"params"},
        )
        self._resolution.vehicles[vehicle.name] = registry.kept(kind, binding.complete(kind, own), self._resolution.keep)
        model: Vehicle = binding.call(kind, own, key=key, origin=self._source, also=also)
        return model

    def _fit(self, vehicle: VehicleTable) -> "dict[str, Sensor]":
        """The sensors of a vehicle, by name; those that ask for its wheels are told."""
        model = self.models[vehicle.name]
        wheels = {name: getattr(model, name) for name in ("wheel_radius_m", "track_m") if hasattr(model, name)}
        fitted, tables = {}, {}
        for name, content in vehicle.sensors.items():
            where = f"vehicle.{vehicle.name}.sensors.{name}"
            if not name.replace("_", "").replace("-", "").isalnum() or name in TOPICS:
                problem = f"a sensor cannot be called '{name}': letters, digits, _ and -, and none of {', '.join(TOPICS)}"
                raise ScenarioError(problem, key=where, source=self._source.of(where))
            fitted[name], tables[name] = self._resolution.component("sensor", content, where, offered=wheels)
        self._resolution.sensors[vehicle.name] = tables
        return fitted

    def _spec(self, vehicle: VehicleTable) -> "VehicleSpec":
        from vcmvsp.physics.sensors.positioning import Positioning
        from vcmvsp.physics.vehicles.specification import VehicleSpec

        key, sensor, fusion = f"vehicle.{vehicle.name}", None, None
        if vehicle.positioning is not None:
            sensor = binding.call(Positioning, vehicle.positioning, key=f"{key}.positioning", origin=self._source)
        position, heading = vehicle.start
        if vehicle.pose_source == "fusion" and not vehicle.is_real:
            from vcmvsp.cosim.estimation.fusion import Fusion  # takes SciPy, and so its time

            at = {"start": (position[0], position[1], heading)}
            fusion = binding.call(Fusion, vehicle.fusion, key=f"{key}.fusion", origin=self._source, given=at)
            self._resolution.real[vehicle.name] = {"fusion": binding.complete(Fusion, vehicle.fusion, without=at)}
        simulated = self.sensors[vehicle.name]
        if vehicle.is_real:  # a real robot has its own
            simulated = {name: each for name, each in simulated.items() if name != "sonar"}
        given = {
            "name": vehicle.name,
            "model": self.models[vehicle.name],
            "position": position,
            "heading": heading,
            "pose_source": vehicle.pose_source,
            "positioning": sensor,
            "fusion": fusion,
            "sensors": simulated,
        }
        spec: VehicleSpec = binding.call(VehicleSpec, {}, key=key, origin=self._source, given=given)
        return spec

    def _check_defaults_taken(self) -> None:
        known = {key for each in self._scenario.vehicle for key in binding.parameters(self._class(each))}
        for name in self._scenario.vehicles:
            if name not in VehicleTable.__struct_fields__ and name not in known:
                key, allowed = f"vehicles.{name}", {*known, *binding.parameters(VehicleTable)} - _NOT_SHARED
                problem = f"no vehicle takes this default: {binding.unknown('key', name, allowed)}"
                raise ScenarioError(problem, key=key, source=self._source.of(key))

    def _check_recorded(self) -> None:
        fitted = {name for each in self.sensors.values() for name in each}
        if unfit := [name for name in self._scenario.record.sensors if name not in fitted | {"*"}]:
            problem = f"no vehicle carries it: {binding.unknown('sensor', unfit[0], fitted | {'*'})}"
            raise ScenarioError(problem, key="record.sensors", source=self._source.of("record.sensors"))


class Placement:
    """All agents, by where they run.

    Args:
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
