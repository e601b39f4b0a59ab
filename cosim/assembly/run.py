"""From a scenario to a run that can start: every part is found, checked, and handed what it needs.

This room alone imports the parts (physics, netsim, agents, hardware), each inside the function that builds it.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import msgspec

from vcmvsp.cosim.agent import Agent, AgentInfo
from vcmvsp.cosim.assembly import bridge, radio, real_vehicles, worlds
from vcmvsp.cosim.assembly.interventions import Operator, check_planned, checks, nothing_moves
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.assembly.vehicles import Fleet, Placement
from vcmvsp.cosim.clock import SECOND_NS, Clock, SimClock, Ticks, WallClock, seconds_to_ns
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError, VcmvspError
from vcmvsp.cosim.federate import ExternalVehicles, Federate, Instants, RunInfo
from vcmvsp.cosim.hosts.manager import Hosts
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.recording.external_inputs import Input, InputLog
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.hardware.federate import Hardware
    from vcmvsp.netsim.bridge.federate import Bridge
    from vcmvsp.netsim.federate import RadioFederate
    from vcmvsp.physics.world.world import World


@dataclass(frozen=True, kw_only=True)
class AssembledRun:
    """The federates of a run, ready to start, and the scenario with everything filled in.

    Use it as a context manager: leaving it releases host processes and sockets.

    Attributes:
        clock: paces the run.
        info: what every federate is told before time 0.
        robots: the federate that drives real vehicles; None: there are none to drive.
        bridge: the federate that exchanges datagrams with programs at wall pace; None: there are no such programs.
        agents: what the hosts say of the agents, by vehicle's name.
        inputs: what comes from outside, for a replay.
        resolution: the complete tables, and files to be kept.
    """

    scenario: Scenario
    source: Source
    clock: Clock
    info: RunInfo
    federates: Sequence[Federate]
    world: "World"
    radio: "RadioFederate"
    operator: Operator
    robots: "Hardware | None"
    bridge: "Bridge | None"
    hosts: Hosts
    agents: Sequence[AgentInfo]
    where: Mapping[str, str]
    radius_m: Mapping[str, float]
    inputs: InputLog
    resolution: Resolution

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.hosts.close()

    def start(self, kernel: Kernel) -> None:
        """Start the federates, or close them all; errors of the scenario name their place in it."""
        try:
            with _located(self.scenario, self.source):
                kernel.start()
        except BaseException:
            with contextlib.suppress(VcmvspError):
                kernel.close()
            raise

    def recorder(self, mcap: BinaryIO | None, tell: Tell = lambda _: None) -> Recorder:
        """A recorder of this run that writes into the binary stream ``mcap``."""
        record = self.scenario.record
        return Recorder(
            self.info,
            record_ticks=Ticks.every(record.period_s),
            mcap=mcap,
            agents=self.agents,
            radius_m=self.radius_m,
            sensors=record.sensors,
            world=self.world,
            tell=tell,
        )

    def resolved(self) -> dict[str, Any]:
        """The scenario with everything filled in (`cosim.assembly.resolved`), and with the interventions made so far."""
        foreign = {vehicle for vehicle, place in self.where.items() if place == "zenoh"}
        resolved = self.resolution.scenario(self.agents, self.hosts.kinds, foreign)
        done = [msgspec.to_builtins(each) for each in self.operator.all]
        return {**resolved, **({"intervention": done} if done else {})}

    @property
    def has_outside(self) -> bool:
        """Whether robots or programs at wall pace take part."""
        return self.robots is not None or self.bridge is not None

    @property
    def files(self) -> Mapping[str, bytes]:
        """Files that the scenario uses, by the name under which they are kept beside the resolved one."""
        return self.resolution.files

    def keep(self, path: Path) -> None:
        """Keep a file with the others."""
        self.resolution.keep(path)


def assemble(
    scenario: Scenario,
    source: Source,
    *,
    clock: Clock | None = None,
    objects: Mapping[str, Agent] | None = None,
    runs: str | None = None,
    listen: str | None = None,
    keys: Path | None = None,
    insecure: bool = False,
    connect: bool = False,
    playback: ExternalVehicles | None = None,
    bridged: Sequence[Input] | None = None,
    recorded_radio: Path | None = None,
    tell: Tell = lambda _: None,
    watch: Callable[[], str | None] | None = None,
) -> AssembledRun:
    """Build the federates of a scenario, and wait until all hosts of agents have joined.

    Args:
        clock: paces the run (`clock_of`).
        runs: where all agents run, whatever the scenario says; ``"encoded"`` is in this process behind the wire's bytes,
            ``"here"`` in this process as far as the scenario names their classes.
        listen: where hosts started by hand dial in, instead of the scenario's ``agents.listen``.
        keys, insecure: admission of hosts on other machines (`cosim.hosts.manager.Hosts`).
        connect: drive the real vehicles and open the bridge; else nothing is connected, which serves to check a scenario.
        playback: real vehicles of an earlier run, instead of their robots.
        bridged: what programs handed over in an earlier run, instead of these programs.
        recorded_radio: table of frames of an earlier run, whose outcomes are repeated.
        watch: asked while hosts are awaited; an answer is the reason to give up.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a host or an agent failed.
    """
    from vcmvsp.agents.federate import AgentHost

    resolution, inputs = Resolution(scenario, source), InputLog()
    clock = clock or SimClock()
    wall = clock if isinstance(clock, WallClock) else WallClock()  # a scenario is only checked: nobody looks at it
    world, resolution.tables["world"] = worlds.build(
        scenario.world, source, seed=scenario.seed, portable=resolution.portable, keep=resolution.keep
    )
    bridges = bool(scenario.bridge.doors) and bridged is None
    air = radio.federate_of(
        scenario, source, resolution, solids=world.solids, recorded=recorded_radio, programs=bridges, tell=tell
    )
    fleet = Fleet(scenario, source, resolution)
    radius_m = {name: model.radius_m for name, model in fleet.models.items()}
    placement = Placement(scenario, source, fleet, dict(objects or {}), runs)
    real = real_vehicles.of_scenario(scenario, source, resolution, fleet.models)
    robots = None
    if real and playback is None:
        from vcmvsp.hardware.federate import Hardware
        from vcmvsp.physics.vehicles.specification import body_of

        around = {name: body_of(model).radius_m for name, model in fleet.models.items()}
        robots = Hardware(real, run=scenario.name, clock=wall, radius_m=around, tell=tell, log=inputs.on, connect=connect)
    outside = playback or robots
    programs = bridge.of_scenario(
        scenario, source, resolution, air=air, clock=wall, bridged=bridged, tell=tell, log=inputs.on, connect=connect
    )
    physics = _physics(scenario, resolution, world=world, vehicles=fleet.specs(), outside=outside)
    operator = _operator(scenario, source, physics, air)
    about = {"scenario": scenario.name, "seed": scenario.seed, "duration_s": scenario.duration_s, "vehicles": [*radius_m]}
    hosts = Hosts(
        scenario.agents,
        AgentHost,
        kinds=placement.kinds,
        listen=listen,
        keys=keys,
        insecure=insecure,
        about=about,
        tell=tell,
        watch=watch,
    )
    try:
        with _located(scenario, source):
            hosts.start(placement.specs, placement.objects)
        agents = tuple(sorted(hosts.infos, key=lambda info: info.vehicle))
        placement.check_defaults_taken(agents)
    except BaseException:
        hosts.close()
        raise
    others = [each for each in (programs.in_run_time, programs.bridge, programs.playback, outside) if each is not None]
    return AssembledRun(
        scenario=scenario,
        source=source,
        clock=clock,
        info=_info(scenario, fleet, agents),
        federates=[physics, air, operator, *hosts.federates, *others],
        world=world,
        radio=air,
        operator=operator,
        robots=robots,
        bridge=programs.bridge,
        hosts=hosts,
        agents=agents,
        where=placement.where,
        radius_m=radius_m,
        inputs=inputs,
        resolution=resolution,
    )


SLOWEST = 1e-6
"""Simulated seconds per second of wall time; the quickest is its inverse."""


def clock_of(scenario: Scenario, speed: float | None, *, replayed: bool) -> Clock:
    """The clock of a run: the wall clock if a speed is given, or if a real robot or a program at wall pace takes part.

    Args:
        scenario: tells whether one does.
        speed: simulated seconds per second of wall time; None: as fast as possible, or 1 with robots and programs.
        replayed: robots and programs are those of a recording, which keeps no pace.
    """
    if speed is not None and not SLOWEST <= speed <= 1.0 / SLOWEST:
        problem = f"must be a positive number, from {SLOWEST:g} to {1.0 / SLOWEST:g}; without it a run is as fast as possible"
        raise UsageError(f"--realtime {speed:g}: {problem}")
    if scenario.real and not replayed and speed not in (None, 1.0):
        names = ", ".join(scenario.real)
        raise UsageError(f"--realtime {speed:g}: real vehicles ({names}) keep to the wall clock, at speed 1")
    live = not replayed and (scenario.real or scenario.bridge.doors)
    return WallClock(speed or 1.0) if live or speed is not None else SimClock()


@contextlib.contextmanager
def _located(scenario: Scenario, source: Source) -> Iterator[None]:
    """Add the line or --set to an error of a part, which knows the wrong key and at most a file of its own."""
    try:
        yield
    except ScenarioError as error:
        if error.source and error.source != source.name:
            raise  # in a file that the scenario names
        key = error.key
        if key in {f"vehicle.{each.name}.position" for each in scenario.vehicle if each.pose is not None}:
            key = f"{key.removesuffix('position')}pose"  # the word that the scenario uses
        raise ScenarioError(error.problem, key=key, source=source.of(key)) from error


def _physics(scenario: Scenario, resolution: Resolution, **given: object) -> Federate:
    content = {"kind": "bullet", **scenario.physics}
    physics: Federate
    physics, resolution.tables["physics"] = resolution.component("physics", content, "physics", given=given)
    return physics


def _operator(scenario: Scenario, source: Source, physics: Federate, air: "RadioFederate") -> Operator:
    planned, vehicles = scenario.intervention, [each.name for each in scenario.vehicle]
    check = checks(vehicles, getattr(physics, "check_move", nothing_moves), air.check_change)
    check_planned(planned, check, source)
    return Operator(planned, vehicles, check)


def _info(scenario: Scenario, fleet: Fleet, agents: Sequence[AgentInfo]) -> RunInfo:
    read = {f"{info.vehicle}/{name}" for info in agents for name in info.sensors}
    return RunInfo(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_ns=seconds_to_ns(scenario.duration_s),
        vehicles=tuple(each.name for each in scenario.vehicle),
        instants=_instants(scenario, agents),
        wanted=tuple(sorted(read | fleet.recorded())),
        periods_s={info.vehicle: float(info.ticks.period) / SECOND_NS for info in agents},
    )


def _instants(scenario: Scenario, agents: Sequence[AgentInfo]) -> tuple[Instants, ...]:
    """Times at which states are needed: agents' ticks, when their commands take effect, and recorded instants."""
    tables = {each.name: each.agent for each in scenario.vehicle}
    trains = [Instants(Ticks.every(scenario.record.period_s), 0, "record.period_s")]
    for info in agents:
        for name, offset_ns in (("period_s", 0), ("latency_s", info.latency_ns)):
            own = getattr(tables[info.vehicle], name, None) is not None
            key = f"vehicle.{info.vehicle}.agent.{name}" if own else f"agents.{name}"
            trains.append(Instants(info.ticks, offset_ns, key))
    return tuple({(each.ticks, each.offset_ns): each for each in reversed(trains)}.values())
