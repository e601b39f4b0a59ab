"""From a scenario to federates: every part is found, checked and built here."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec

from cosim import bridging, component, radio, real, registry, table
from cosim.agent import SHOWN, Agent, AgentSpec
from cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from cosim.errors import ScenarioError, VcmvspError
from cosim.federate import Federate, Instants, RunInfo
from cosim.hosts import Hosts, Tell
from cosim.interventions import Operator, check_planned, checks, nothing_moves
from cosim.kernel import Kernel
from cosim.record.inputs import Input
from cosim.resolve import Resolution
from cosim.scenario_tables import AgentsTable, AgentTable, Scenario, VehicleTable
from cosim.source import Source

if TYPE_CHECKING:
    from cosim.outside import Vehicles
    from cosim.transport.topics import Topics

TOPICS = (
    *("state", "estimate", "odometry", "fix", "command", "send", "heard", "note", "follows", "host", "real", "incident"),
    *SHOWN.values(),
)
"""Of every vehicle."""
_NOT_SHARED = {"name", "pose", "position", "agent", "driver", "localisation", "params"}
"""Keys of a vehicle for which [vehicles] has no default."""


class Assembly:
    """The federates of a run, ready to start, and the scenario as it really is.

    Use it as a context manager: leaving it lets go of host processes and sockets.

    Args:
        scenario: what to build.
        source: where it was read from.
        objects: agents that exist already, by vehicle; they run in this process.
        runs: where all agents run, whatever the scenario says; ``"encoded"`` is in this process behind the wire's bytes,
            ``"here"`` in this process as far as the scenario names their classes.
        listen: where hosts started by hand dial in, instead of the scenario's ``agents.listen``.
        keys, insecure: who may dial in there from other machines (`cosim.hosts.Hosts`).
        robots: drive the real vehicles of the scenario; else nothing is connected, which serves to check it.
        playback: gives what real vehicles did in an earlier run, in their place.
        bridged: what programs handed over in an earlier run, in their place.
        recorded_radio: a table of frames which fare again as they did in an earlier run.
        tell: takes lines for the user.
        watch: asked while hosts are waited for; an answer is why there is no use in it.
    """

    def __init__(
        self,
        scenario: Scenario,
        source: Source,
        *,
        objects: Mapping[str, Agent] | None = None,
        runs: str | None = None,
        listen: str | None = None,
        keys: Path | None = None,
        insecure: bool = False,
        robots: bool = False,
        playback: "Vehicles | None" = None,
        bridged: Sequence[Input] | None = None,
        recorded_radio: Path | None = None,
        tell: Tell = lambda _: None,
        watch: Callable[[], str | None] | None = None,
    ) -> None:
        registry.guard()
        self._scenario, self._source, self._objects = scenario, source, dict(objects or {})
        self.clock = scenario.clock
        self.where: dict[str, str] = {}  # vehicle -> where its agent runs
        self._classes: dict[str, Any] = {}  # of vehicles, by kind
        self._sensors: dict[str, dict[str, Any]] = {}  # of each vehicle, by name
        unknown = [name for name in self._objects if name not in {each.name for each in scenario.vehicle}]
        if unknown:
            problem = table.unknown("vehicle", unknown[0], [each.name for each in scenario.vehicle])
            raise ScenarioError(problem, key="agents")
        agents = scenario.agents if listen is None else msgspec.structs.replace(scenario.agents, listen=listen)
        self._resolution = Resolution(scenario, source)
        world = self.world = self._build_world()
        air = self.air = self._build_radio(world, recorded_radio, tell)
        self._models = {each.name: self._model(each) for each in scenario.vehicle}
        described = real.of_scenario(scenario, source, self._resolution, self._models)
        self.robots: Any = None  # the federate that drives real vehicles, if there are any to drive
        if described and playback is None:
            self.robots = registry.piece("hardware")(described, run=scenario.name, tell=tell, connect=robots)
        self._outside = playback or self.robots
        programs = self._build_programs(air, bridged, tell, connect=robots)
        physics = self._build_physics(world)
        self.radius_m: Mapping[str, float] = physics.radius_m
        about = {"scenario": scenario.name, "seed": scenario.seed, "duration_s": scenario.duration_s}
        about["vehicles"] = [each.name for each in scenario.vehicle]
        self._hosts = Hosts(agents, tell, keys=keys, insecure=insecure, watch=watch, about=about)
        try:
            self._place_agents(runs)
            if listen is not None and self._hosts.hub is None:
                self._hosts.listen()  # for those who watch
            self.infos = tuple(sorted(self._hosts.infos, key=lambda info: info.vehicle))
            self._check_defaults_taken()
        except BaseException:
            self._hosts.close()
            raise
        self.operator = self._build_operator(physics, air)
        self.federates: list[Federate] = [physics, air, self.operator, *self._hosts.federates, *programs]
        if self._outside is not None:
            self.federates.append(self._outside)
        if self.robots is not None:
            self.robots.radius_m = self.radius_m
            self.robots.periods_s = {info.vehicle: float(info.ticks.period) / SECOND_NS for info in self.infos}
        self.record_ticks = Ticks.every(scenario.record.period_s)
        self.recorded_sensors = scenario.record.sensors
        fitted = {name for each in self._sensors.values() for name in each}
        if unfit := [name for name in scenario.record.sensors if name not in fitted | {"*"}]:
            problem = f"no vehicle carries it: {table.unknown('sensor', unfit[0], fitted | {'*'})}"
            raise ScenarioError(problem, key="record.sensors", source=source.of("record.sensors"))
        self.run_info = RunInfo(
            scenario=scenario.name,
            seed=scenario.seed,
            duration_ns=seconds_to_ns(scenario.duration_s),
            vehicles=tuple(each.name for each in scenario.vehicle),
            instants=self._instants(),
            wanted=self._wanted(),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._hosts.close()

    def start(self, kernel: Kernel) -> None:
        """Start the federates, or close them all; what they find wrong with the scenario is said with its place in it."""
        try:
            with self._placed():
                kernel.start()
        except BaseException:
            with contextlib.suppress(VcmvspError):
                kernel.close()
            raise

    @contextlib.contextmanager
    def _placed(self) -> Iterator[None]:
        """A part knows the key that is wrong, and at most a file of its own; here the line or --set is known too."""
        try:
            yield
        except ScenarioError as error:
            if error.source and error.source != self._source.name:
                raise  # in a file that the scenario names
            key = error.key
            if key in {f"vehicle.{each.name}.position" for each in self._scenario.vehicle if each.pose is not None}:
                key = f"{key.removesuffix('position')}pose"  # the word that the scenario uses
            raise ScenarioError(error.problem, key=key, source=self._source.of(key)) from error

    def resolved(self) -> dict[str, Any]:
        """The scenario with everything filled in (`cosim.resolve`)."""
        foreign = {vehicle for vehicle, place in self.where.items() if place == "zenoh"}
        resolved = self._resolution.scenario(self.infos, self._hosts.kinds, foreign)
        done = [msgspec.to_builtins(each) for each in self.operator.all]
        return {**resolved, **({"intervention": done} if done else {})}

    @property
    def topics(self) -> "Topics | None":
        """What is shown to those who watch from elsewhere; None: nobody can."""
        return self._hosts.topics

    @property
    def cuts_s(self) -> Mapping[str, Sequence[float]]:
        """For how long hosts were out of reach, each time that the run waited for them, by their vehicles."""
        return self._hosts.cuts_s

    @property
    def outsiders(self) -> Sequence[Any]:
        """Federates that bring something into the run which no scenario tells: their `log` is given it, for a replay."""
        return [each for each in (self.robots, self.bridge) if each is not None]

    @property
    def files(self) -> Mapping[str, bytes]:
        """Python files that the scenario uses, by the name under which they are kept beside the resolved one."""
        return self._resolution.files

    def keep(self, path: Path) -> None:
        """Keep a file with the others."""
        self._resolution.keep(path)

    # --- parts --------------------------------------------------------------------------------------------------------------

    def _component(
        self, group: str, content: Mapping[str, Any], key: str, *, offered: Mapping[str, Any] | None = None, **given: Any
    ) -> tuple[Any, dict[str, Any]]:
        portable, keep = self._resolution.portable, self._resolution.keep
        return component.build(
            group, content, key=key, source=self._source, portable=portable, given=given, offered=offered, keep=keep
        )

    def _build_world(self) -> Any:
        portable, keep = self._resolution.portable, self._resolution.keep
        table_, seed = self._scenario.world, self._scenario.seed
        world, resolved = component.world_of(table_, self._source, seed=seed, portable=portable, keep=keep)
        self._resolution.tables["world"] = resolved
        return world

    def _build_radio(self, world: Any, recorded: Path | None, tell: Tell) -> Any:
        portable, keep = self._resolution.portable, self._resolution.keep
        built = radio.of_scenario(
            self._scenario, self._source, solids=world.solids, portable=portable, keep=keep, recorded=recorded, tell=tell
        )
        self._resolution.tables.update(built.resolved)
        return built.federate

    def _build_physics(self, world: Any) -> Any:
        specs = [self._vehicle_spec(each, self._models[each.name]) for each in self._scenario.vehicle]
        content = {"kind": "bullet", **self._scenario.physics}
        given = {"world": world, "vehicles": specs, "outside": self._outside}
        physics, resolved = self._component("physics", content, "physics", **given)
        self._resolution.tables["physics"] = resolved
        known = {key for each in self._scenario.vehicle for key in table.parameters(self._vehicle_class(each))}
        for name in self._scenario.vehicles:
            if name not in VehicleTable.__struct_fields__ and name not in known:
                key, allowed = f"vehicles.{name}", {*known, *table.parameters(VehicleTable)} - _NOT_SHARED
                problem = f"no vehicle takes this default: {table.unknown('key', name, allowed)}"
                raise ScenarioError(problem, key=key, source=self._source.of(key))
        return physics

    def _build_operator(self, physics: Any, air: Any) -> Operator:
        planned, vehicles = self._scenario.intervention, [each.name for each in self._scenario.vehicle]
        check = checks(vehicles, getattr(physics, "check_move", nothing_moves), air.check_change)
        check_planned(planned, check, self._source)
        return Operator(planned, vehicles, check)

    def _build_programs(self, air: Any, bridged: Sequence[Input] | None, tell: Tell, *, connect: bool) -> list[Federate]:
        """The federates that carry what programs outside send, or have sent in an earlier run."""
        scenario, source = self._scenario, self._source
        runs = connect or bridged is not None  # those of a replay speak anew
        programs = bridging.programs_of(scenario, source, self._resolution, tell=tell, connect=runs)
        doors = bridging.doors_of(scenario, source, self._resolution)
        self.bridge: Any = None  # the one at wall pace, if there are programs to be reached
        if doors and bridged is None:
            self.bridge = bridging.bridge_of(doors, scenario, source, air=air, tell=tell, connect=connect)
            programs.append(self.bridge)
            air.programs = True
        elif bridged is not None:
            programs.append(registry.piece("bridge playback")(bridged))
        return programs

    def _vehicle_class(self, vehicle: VehicleTable) -> Any:
        """The class of a vehicle's kind, looked up once: a file is not executed again for every vehicle."""
        if vehicle.kind not in self._classes:
            key = f"vehicle.{vehicle.name}.kind"
            found = registry.find("vehicle", vehicle.kind, folder=self._source.folder, key=key, origin=self._source)
            self._classes[vehicle.kind] = found
        return self._classes[vehicle.kind]

    def _own(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The parameters of a vehicle; a default of ``[vehicles]`` counts only where the kind takes it."""
        known = table.parameters(self._vehicle_class(vehicle))
        defaults = self._scenario.vehicles
        params = self._source.kept(vehicle.params, f"vehicle.{vehicle.name}", known)
        return {n: v for n, v in params.items() if n in known or n not in defaults}

    def _model(self, vehicle: VehicleTable) -> Any:
        """What a vehicle is."""
        key, kind = f"vehicle.{vehicle.name}", self._vehicle_class(vehicle)
        own, also = component.found(self._own(vehicle), self._source), {*table.parameters(VehicleTable)} - {"params"}
        self._resolution.vehicles[vehicle.name] = component.kept(table.complete(kind, own), self._resolution.keep)
        return table.call(kind, own, key=key, origin=self._source, also=also)

    def _vehicle_spec(self, vehicle: VehicleTable, model: Any) -> Any:
        key, sensor, fusion = f"vehicle.{vehicle.name}", None, None
        if vehicle.positioning is not None:
            positioning = registry.piece("positioning")
            sensor = table.call(positioning, vehicle.positioning, key=f"{key}.positioning", origin=self._source)
        position, heading = vehicle.start
        if vehicle.pose_source == "fusion" and not vehicle.is_real:
            kind, at = registry.piece("fusion"), {"start": (position[0], position[1], heading)}
            fusion = table.call(kind, vehicle.fusion, key=f"{key}.fusion", origin=self._source, given=at)
            self._resolution.real[vehicle.name] = {"fusion": table.complete(kind, vehicle.fusion, without=at)}
        given = {
            "name": vehicle.name,
            "model": model,
            "position": position,
            "heading": heading,
            "pose_source": vehicle.pose_source,
            "positioning": sensor,
            "fusion": fusion,
            "sensors": self._fit(vehicle, model),
        }
        return table.call(registry.piece("vehicle spec"), {}, key=key, origin=self._source, given=given)

    def _fit(self, vehicle: VehicleTable, model: Any) -> dict[str, Any]:
        """The sensors of a vehicle, by name; those that ask for its wheels are told."""
        wheels = {name: getattr(model, name) for name in ("wheel_radius_m", "track_m") if hasattr(model, name)}
        fitted, tables = {}, {}
        for name, content in vehicle.sensors.items():
            where = f"vehicle.{vehicle.name}.sensors.{name}"
            if not name.replace("_", "").replace("-", "").isalnum() or name in TOPICS:
                problem = f"a sensor cannot be called '{name}': letters, digits, _ and -, and none of {', '.join(TOPICS)}"
                raise ScenarioError(problem, key=where, source=self._source.of(where))
            fitted[name], tables[name] = self._component("sensor", content, where, offered=wheels)
        self._sensors[vehicle.name], self._resolution.sensors[vehicle.name] = fitted, tables
        if not vehicle.is_real:
            return fitted
        return {name: each for name, each in fitted.items() if name != "sonar"}  # a real robot has its own

    # --- agents -------------------------------------------------------------------------------------------------------------

    def _place_agents(self, runs: str | None) -> None:
        places: dict[str, list[AgentSpec]] = {}
        for vehicle in self._scenario.vehicle:
            if vehicle.agent is None and vehicle.name not in self._objects:
                continue
            where: str = (vehicle.agent and vehicle.agent.runs) or self._scenario.agents.runs
            if runs == "here":  # all but what only a host elsewhere can name
                if where == "zenoh" and not self._kind(vehicle):
                    continue
                where = "inprocess"
            where = "inprocess" if vehicle.name in self._objects else runs if runs and runs != "here" else where
            places.setdefault(where, []).append(self._agent_spec(vehicle, where))
            self.where[vehicle.name] = where
        start = {
            "inprocess": lambda specs: self._hosts.run_here(specs, self._objects),
            "encoded": self._hosts.run_encoded,
            "process": self._hosts.run_in_processes,
            "zenoh": self._hosts.await_by_hand,
        }
        with self._placed():
            for where, specs in sorted(places.items()):
                start[where](specs)

    def _kind(self, vehicle: VehicleTable) -> str:
        """The kind of a vehicle's agent, as far as the scenario says it."""
        return (vehicle.agent and vehicle.agent.kind) or self._scenario.agents.defaults.get("kind", "")

    def _agent_spec(self, vehicle: VehicleTable, where: str) -> AgentSpec:
        agents, own = self._scenario.agents, vehicle.agent
        fate = own or AgentTable()
        kind = self._kind(vehicle)
        if vehicle.name in self._objects:
            made = type(self._objects[vehicle.name])
            if not kind or registry.target("agent", kind).rpartition(":")[2] != made.__qualname__:
                self._hosts.kinds[vehicle.name] = kind = f"{made.__module__}:{made.__qualname__}"
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
            sensors=tuple(self._sensors[vehicle.name]),
            beside_m={
                name: beside
                for name, each in self._sensors[vehicle.name].items()
                if (beside := math.hypot(*getattr(each, "position", (0.0, 0.0))[:2])) > 0.0
            },
            body=registry.piece("vehicle body")(self._models[vehicle.name]),
            fails_s=fate.fails_s,
            on_lost=fate.on_lost or agents.on_lost,
            hold_s=agents.hold_s if fate.hold_s is None else fate.hold_s,
        )

    def _check_defaults_taken(self) -> None:
        taken = {name for info in self.infos for name in info.taken}
        if any(each.agent and not each.agent.kind for each in self._scenario.vehicle):
            taken.add("kind")
        for name in self._scenario.agents.defaults:
            if name not in taken:
                key = f"agents.{name}"
                known = {each for info in self.infos for each in info.known}
                why = f"every agent that has it sets its own '{name}'" if name in known or name == "kind" else None
                if not self.infos:
                    why = "no vehicle has an agent (a vehicle gets one by an agent table, which may be empty: agent = {})"
                allowed = {*known, *table.parameters(AgentsTable), "kind"} - {"defaults"}
                problem = f"no agent takes this default: {why or table.unknown('key', name, allowed)}"
                raise ScenarioError(problem, key=key, source=self._source.of(key))

    def _instants(self) -> tuple[Instants, ...]:
        """When states are needed: at agents' ticks, when what they decided takes effect, and where they are recorded."""
        trains = [Instants(self.record_ticks, 0, "record.period_s")]
        for info in self.infos:
            for name, offset_ns in (("period_s", 0), ("latency_s", info.latency_ns)):
                own = f"vehicle.{info.vehicle}.agent.{name}"
                trains.append(Instants(info.ticks, offset_ns, own if self._is_own(info.vehicle, name) else f"agents.{name}"))
        return tuple({(each.ticks, each.offset_ns): each for each in reversed(trains)}.values())

    def _wanted(self) -> tuple[str, ...]:
        """Readings that agents say they look at, and those that are recorded."""
        looked = {f"{info.vehicle}/{name}" for info in self.infos for name in info.sensors}
        kept = self.recorded_sensors
        recorded = {f"{v}/{s}" for v, fitted in self._sensors.items() for s in fitted if s in kept or "*" in kept}
        return tuple(sorted(looked | recorded))

    def _is_own(self, vehicle: str, name: str) -> bool:
        agent = next(each.agent for each in self._scenario.vehicle if each.name == vehicle)
        return agent is not None and getattr(agent, name) is not None
