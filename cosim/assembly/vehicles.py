"""Build the vehicles of a scenario and their sensors, and decide where their agents run."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.agent import SHOWN, Agent, AgentInfo, AgentSpec, DrivenVehicle
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
"""Topics of every vehicle; no sensor may have such a name."""
BATTERY = "battery"
"""Name of the reading of a vehicle's battery."""
_NOT_SHARED = {"name", "pose", "position", "agent", "driver", "firmware", "localisation", "params"}
"""Keys of a vehicle for which [vehicles] has no default."""


class Fleet:
    """All vehicles, with their sensors.

    Args:
        resolution: receives the complete tables.

    Attributes:
        models: model of each vehicle, an object of the class of its kind.
        sensors: sensors by vehicle and sensor name.

    Raises:
        ScenarioError: a table is wrong, or no vehicle has a key of ``[vehicles]`` or a sensor of ``record.sensors``.
    """

    def __init__(self, scenario: Scenario, source: Source, resolution: Resolution) -> None:
        self._scenario, self._source, self._resolution = scenario, source, resolution
        self._classes: dict[str, type[Vehicle]] = {}  # by kind
        self.models: Mapping[str, Vehicle] = {each.name: self._model(each) for each in scenario.vehicle}
        self.sensors: Mapping[str, Mapping[str, Sensor]] = {each.name: self._fit(each) for each in scenario.vehicle}
        self._check_defaults_taken()
        self._check_recorded()

    def specs(self) -> "list[VehicleSpec]":
        """Specification of each vehicle for physics, in the scenario's order."""
        return [self._spec(each) for each in self._scenario.vehicle]

    def recorded(self) -> set[str]:
        """Keys of the recorded readings, ``vehicle/sensor``."""
        selection = self._scenario.record.sensors
        return {f"{v}/{s}" for v, fitted in self.sensors.items() for s in fitted if s in selection or "*" in selection}

    def _class(self, vehicle: VehicleTable) -> "type[Vehicle]":
        """The class of a vehicle's kind, cached so that a file is executed once."""
        kind, source = vehicle.kind, self._source
        if kind not in self._classes:
            key = f"vehicle.{vehicle.name}.kind"
            self._classes[kind] = registry.find("vehicle", kind, folder=source.folder, key=key, origin=source)
        return self._classes[kind]

    def _own(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The parameters of a vehicle; defaults of ``[vehicles]`` apply only to kinds that take them."""
        known = binding.parameters(self._class(vehicle))
        defaults = self._scenario.vehicles
        params = self._source.parameters(vehicle.params, f"vehicle.{vehicle.name}", known)
        return {n: v for n, v in params.items() if n in known or n not in defaults}

    def _model(self, vehicle: VehicleTable) -> "Vehicle":
        key, kind = f"vehicle.{vehicle.name}", self._class(vehicle)
        content = self._own(vehicle)
        if vehicle.firmware is not None and "frame" in binding.parameters(kind):
            content = {"frame": "x", **content}
        own = registry.with_real_paths(kind, content, self._source, key)
        full = binding.complete(kind, own)
        self._resolution.vehicles[vehicle.name] = registry.with_kept_files(kind, full, self._resolution.keep)
        also = {*binding.parameters(VehicleTable)} - {"params"}
        return binding.call(kind, own, key=key, origin=self._source, also=also)

    def _fit(self, vehicle: VehicleTable) -> "dict[str, Sensor]":
        """The sensors of a vehicle, by name; sensors with a parameter for the wheels receive them."""
        model = self.models[vehicle.name]
        wheels = {name: getattr(model, name) for name in ("wheel_radius_m", "track_m") if hasattr(model, name)}
        fitted, tables = {}, {}
        for name, content in vehicle.sensors.items():
            where = f"vehicle.{vehicle.name}.sensors.{name}"
            if name == BATTERY and vehicle.battery is not None:
                problem = f"'{BATTERY}' is the reading of the table vehicle.{vehicle.name}.battery: choose another name"
                raise self._source.error(problem, where)
            if not name.replace("_", "").replace("-", "").isalnum() or name in TOPICS:
                problem = f"'{name}' is not a valid sensor name: use letters, digits, _ and -, but none of {', '.join(TOPICS)}"
                raise self._source.error(problem, where)
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
            from vcmvsp.cosim.estimation.fusion import Fusion  # slow import: SciPy

            at = {"start": (position[0], position[1], heading)}
            fusion = binding.call(Fusion, vehicle.fusion, key=f"{key}.fusion", origin=self._source, arguments=at)
            self._resolution.real[vehicle.name] = {"fusion": binding.complete(Fusion, vehicle.fusion, without=at)}
        simulated = self.sensors[vehicle.name]
        if vehicle.is_real:  # a real robot carries its own sensors
            simulated = {name: each for name, each in simulated.items() if name != "sonar"}
        arguments = {
            "name": vehicle.name,
            "model": self.models[vehicle.name],
            "position": position,
            "heading": heading,
            "pose_source": vehicle.pose_source,
            "positioning": sensor,
            "fusion": fusion,
            "sensors": simulated,
        }
        return binding.call(VehicleSpec, {}, key=key, origin=self._source, arguments=arguments)

    def _check_defaults_taken(self) -> None:
        known = {key for each in self._scenario.vehicle for key in binding.parameters(self._class(each))}
        for name in self._scenario.vehicles:
            if name not in VehicleTable.__struct_fields__ and name not in known:
                key, allowed = f"vehicles.{name}", {*known, *binding.parameters(VehicleTable)} - _NOT_SHARED
                raise self._source.error(f"no vehicle has this parameter: {binding.unknown('key', name, allowed)}", key)

    def _check_recorded(self) -> None:
        fitted = {name for each in self.sensors.values() for name in each}
        if unfit := [name for name in self._scenario.record.sensors if name not in fitted | {"*"}]:
            problem = f"no vehicle has this sensor: {binding.unknown('sensor', unfit[0], fitted | {'*'})}"
            raise self._source.error(problem, "record.sensors")


class Placement:
    """All agents, by where they run.

    Args:
        objects: existing agents, by vehicle; they run in this process. Also an attribute.
        runs: where all run, overriding the scenario; ``"here"``: in this process if the scenario names their class. None: as in
            the scenario.
        stacked: place of the vehicles that stacks drive in place of their agents.

    Attributes:
        specs: agent specifications for the hosts, by place: ``inprocess``, ``driven``, ``process``, ``zenoh`` or a stack's.
        where: place by vehicle.
        kinds: classes of the given objects, which replace the scenario's, by vehicle.

    Raises:
        ScenarioError: an object has no vehicle, or an agent has no kind.
    """

    def __init__(
        self,
        scenario: Scenario,
        source: Source,
        fleet: Fleet,
        objects: Mapping[str, Agent],
        runs: str | None,
        stacked: Mapping[str, str],
    ) -> None:
        self._scenario, self._source, self._fleet, self._stacked = scenario, source, fleet, stacked
        if twice := [name for name in objects if name in stacked]:
            raise ScenarioError(f"{stacked[twice[0]]} drives {twice[0]} already", key=f"agents.{twice[0]}")
        self.objects = {**objects, **{name: DrivenVehicle() for name in stacked}}
        names = [each.name for each in scenario.vehicle]
        if unknown := [name for name in objects if name not in names]:
            raise ScenarioError(binding.unknown("vehicle", unknown[0], names), key="agents")
        for name, each in objects.items():
            if not isinstance(each, Agent):
                description = f"a class: write {each.__name__}(...)" if isinstance(each, type) else binding.show(each)
                raise ScenarioError(
                    f"must be an object of a class derived from vcmvsp.Agent, not {description}", key=f"agents.{name}"
                )
        self.specs: dict[str, list[AgentSpec]] = {}
        self.where: dict[str, str] = {}
        self.kinds: dict[str, str] = {}
        for vehicle in scenario.vehicle:
            if (where := self._place(vehicle, runs)) is not None:
                self.specs.setdefault(where, []).append(self._spec(vehicle, where))
                self.where[vehicle.name] = where

    def check_defaults_taken(self, infos: Sequence[AgentInfo]) -> None:
        """Raise `ScenarioError` if no agent takes a default of ``[agents]``."""
        taken = {name for info in infos for name in info.taken}
        if any(each.agent and not each.agent.kind for each in self._scenario.vehicle):
            taken.add("kind")
        for name in self._scenario.agents.defaults:
            if name not in taken:
                key = f"agents.{name}"
                known = {each for info in infos for each in info.known}
                why = f"all agents with this parameter set their own '{name}'" if name in known or name == "kind" else None
                if not infos:
                    why = "no vehicle has an agent (add an agent table, which may be empty: agent = {})"
                allowed = {*known, *binding.parameters(AgentsTable), "kind"} - {"defaults"}
                raise self._source.error(f"this default has no effect: {why or binding.unknown('key', name, allowed)}", key)

    def _place(self, vehicle: VehicleTable, runs: str | None) -> str | None:
        """Where a vehicle's agent runs; None: it has no agent, or with ``here`` no known class."""
        if vehicle.name in self._stacked:
            return self._stacked[vehicle.name]
        if vehicle.name in self.objects:
            return "driven" if isinstance(self.objects[vehicle.name], DrivenVehicle) else "inprocess"
        if vehicle.agent is None:
            return None
        where = vehicle.agent.runs or self._scenario.agents.runs
        if runs == "here":
            return None if where == "zenoh" and not self._kind(vehicle) else "inprocess"
        return runs or where

    def _kind(self, vehicle: VehicleTable) -> str:
        """The kind of a vehicle's agent in the scenario."""
        return (vehicle.agent and vehicle.agent.kind) or self._scenario.agents.defaults.get("kind", "")

    def _spec(self, vehicle: VehicleTable, where: str) -> AgentSpec:
        from vcmvsp.physics.vehicles.specification import body_of

        agents, own = self._scenario.agents, vehicle.agent
        fate = own or AgentTable()
        kind, key = self._kind(vehicle), f"vehicle.{vehicle.name}.agent.kind"
        if vehicle.name in self.objects:
            agent_class = type(self.objects[vehicle.name])
            target = registry.target("agent", kind, key=key, origin=self._source) if kind else ""
            if target.rpartition(":")[2] != agent_class.__qualname__:
                self.kinds[vehicle.name] = kind = f"{agent_class.__module__}:{agent_class.__qualname__}"
                own = None  # the scenario's table belongs to another class
        if not kind and where != "zenoh":
            raise self._source.error("is missing, and [agents] has no kind for all", key)
        defaults = {name: value for name, value in agents.defaults.items() if name != "kind"}
        params = self._source.parameters(own.params, f"vehicle.{vehicle.name}.agent", ()) if own else {}
        if own and len(params) < len(own.params):  # not the file's class: only parameters that it takes
            defaults |= {name: value for name, value in own.params.items() if name not in params}
        replaced = {}
        for prefix, table in (("agents", defaults), (f"vehicle.{vehicle.name}.agent", params)):
            for name in table:
                if (names := self._source.replaced(f"{prefix}.{name}")) is not None:
                    replaced[name] = names
        latency_s = agents.latency_s if fate.latency_s is None else fate.latency_s
        hold_s = agents.hold_s if fate.hold_s is None else fate.hold_s
        sensors = self._fleet.sensors[vehicle.name]
        battery = () if vehicle.battery is None else (BATTERY,)
        return AgentSpec(
            vehicle=vehicle.name,
            kind=kind,
            folder=str(self._source.folder.resolve()),
            params=params,
            defaults=defaults,
            replaced=replaced,
            period_s=fate.period_s or agents.period_s,
            latency_s=latency_s,
            source=self._source.name,
            sensors=(*sensors, *battery),
            battery=bool(battery),
            beside_m={
                name: beside
                for name, each in sensors.items()
                if (beside := math.hypot(*getattr(each, "position", (0.0, 0.0))[:2])) > 0.0
            },
            body=body_of(self._fleet.models[vehicle.name]),
            fails_s=fate.fails_s,
            on_lost=fate.on_lost or agents.on_lost,
            hold_s=hold_s,
        )
