"""From a scenario to federates: every part is found, checked and built here."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec

from vcmvsp.cosim.agent import Agent
from vcmvsp.cosim.assembly import bridge, radio, real_vehicles
from vcmvsp.cosim.assembly.agents import Placement
from vcmvsp.cosim.assembly.interventions import Operator, check_planned, checks, nothing_moves
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.assembly.vehicles import Fleet
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.config import factory, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, VcmvspError
from vcmvsp.cosim.federate import Federate, Instants, RunInfo
from vcmvsp.cosim.hosts.manager import Hosts
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.event_publisher import Topics
    from vcmvsp.cosim.kernel.external_vehicles import Vehicles


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
        keys, insecure: who may dial in there from other machines (`cosim.hosts.manager.Hosts`).
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
        self._scenario, self._source, self._objects = scenario, source, dict(objects or {})
        self.clock = scenario.clock
        agents = scenario.agents if listen is None else msgspec.structs.replace(scenario.agents, listen=listen)
        self._resolution = Resolution(scenario, source)
        world = self.world = self._build_world()
        air = self.air = self._build_radio(world, recorded_radio, tell)
        fleet = self._fleet = Fleet(scenario, source, self._resolution)
        placement = Placement(scenario, source, fleet, self._objects, runs)
        self.where = placement.where  # vehicle -> where its agent runs
        described = real_vehicles.of_scenario(scenario, source, self._resolution, fleet.models)
        self.robots: Any = None  # the federate that drives real vehicles, if there are any to drive
        if described and playback is None:
            self.robots = registry.piece("hardware")(described, run=scenario.name, tell=tell, connect=robots)
        self._outside = playback or self.robots
        programs = self._build_programs(air, bridged, tell, connect=robots)
        physics = self._build_physics(world)
        self.radius_m: Mapping[str, float] = physics.radius_m
        self.operator = self._build_operator(physics, air)
        about = {"scenario": scenario.name, "seed": scenario.seed, "duration_s": scenario.duration_s}
        about["vehicles"] = [each.name for each in scenario.vehicle]
        self._hosts = Hosts(agents, tell, keys=keys, insecure=insecure, watch=watch, about=about)
        try:
            self._start_hosts(placement)
            if listen is not None and self._hosts.entrance is None:
                self._hosts.listen()  # for those who watch
            self.infos = tuple(sorted(self._hosts.infos, key=lambda info: info.vehicle))
            placement.check_defaults_taken(self.infos)
        except BaseException:
            self._hosts.close()
            raise
        self.federates: list[Federate] = [physics, air, self.operator, *self._hosts.federates, *programs]
        if self._outside is not None:
            self.federates.append(self._outside)
        if self.robots is not None:
            self.robots.radius_m = self.radius_m
            self.robots.periods_s = {info.vehicle: float(info.ticks.period) / SECOND_NS for info in self.infos}
        self.record_ticks = Ticks.every(scenario.record.period_s)
        self.recorded_sensors = scenario.record.sensors
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
        """The scenario with everything filled in (`cosim.assembly.resolved`)."""
        foreign = {vehicle for vehicle, place in self.where.items() if place == "zenoh"}
        resolved = self._resolution.scenario(self.infos, self._hosts.kinds, foreign)
        done = [msgspec.to_builtins(each) for each in self.operator.all]
        return {**resolved, **({"intervention": done} if done else {})}

    @property
    def topics(self) -> "Topics | None":
        """What is shown to those who watch from elsewhere; None: nobody can."""
        return None if self._hosts.entrance is None else self._hosts.entrance.topics

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

    def _build_world(self) -> Any:
        portable, keep = self._resolution.portable, self._resolution.keep
        table_, seed = self._scenario.world, self._scenario.seed
        world, resolved = factory.world_of(table_, self._source, seed=seed, portable=portable, keep=keep)
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
        content = {"kind": "bullet", **self._scenario.physics}
        given = {"world": world, "vehicles": self._fleet.specs(), "outside": self._outside}
        physics, resolved = self._resolution.component("physics", content, "physics", given=given)
        self._resolution.tables["physics"] = resolved
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
        programs = bridge.programs_of(scenario, source, self._resolution, tell=tell, connect=runs)
        doors = bridge.doors_of(scenario, source, self._resolution)
        self.bridge: Any = None  # the one at wall pace, if there are programs to be reached
        if doors and bridged is None:
            self.bridge = bridge.bridge_of(doors, scenario, source, air=air, tell=tell, connect=connect)
            programs.append(self.bridge)
            air.programs = True
        elif bridged is not None:
            programs.append(registry.piece("bridge playback")(bridged))
        return programs

    def _start_hosts(self, placement: Placement) -> None:
        start = {
            "inprocess": lambda specs: self._hosts.run_here(specs, self._objects),
            "encoded": self._hosts.run_encoded,
            "process": self._hosts.run_in_processes,
            "zenoh": self._hosts.await_by_hand,
        }
        self._hosts.kinds |= placement.kinds
        with self._placed():
            for where, specs in sorted(placement.specs.items()):
                start[where](specs)

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
        return tuple(sorted(looked | self._fleet.recorded()))

    def _is_own(self, vehicle: str, name: str) -> bool:
        agent = next(each.agent for each in self._scenario.vehicle if each.name == vehicle)
        return agent is not None and getattr(agent, name) is not None
