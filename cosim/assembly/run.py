"""Assemble a run from a scenario: builds, checks and connects all parts.

Only this package imports the parts (physics, netsim, agents, hardware), each inside the function that builds it.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Self

import msgspec

from vcmvsp.cosim.agent import Agent, AgentInfo
from vcmvsp.cosim.assembly import bridge, firmware, radio, real_vehicles, stacks, worlds
from vcmvsp.cosim.assembly.interventions import Operator, check_planned, checks, nothing_moves
from vcmvsp.cosim.assembly.remarks import remarks
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.assembly.vehicles import Fleet, Placement
from vcmvsp.cosim.clock import SECOND_NS, Clock, SimClock, Ticks, WallClock, seconds_to_ns
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError, VcmvspError
from vcmvsp.cosim.federate import ExternalVehicles, Federate, Instants, RunInfo, Stack
from vcmvsp.cosim.hosts.manager import Hosts
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.metrics.own import Metric, maker_of
from vcmvsp.cosim.recording.external_inputs import Input, InputLog
from vcmvsp.cosim.recording.mcap_writer import MessageSink
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
    """The federates of a run, ready to start, and the resolved scenario.

    Use it as a context manager: leaving it releases host processes and sockets.

    Attributes:
        clock: paces the run.
        info: run information that every federate receives before time 0.
        robots: the federate that drives real vehicles; None: no vehicle is driven.
        bridge: the federate that exchanges datagrams with programs in wall time; None: no such programs.
        stacks: programs that drive simulated vehicles, by place.
        agents: the hosts' descriptions of the agents, by vehicle.
        metrics: own metrics, by name.
        inputs: external inputs, recorded for a replay.
        resolution: the complete tables, and the files to keep.
    """

    scenario: Scenario
    source: Source
    clock: Clock
    info: RunInfo
    federates: Sequence[Federate]
    world: "World"
    radios: "Sequence[RadioFederate]"
    operator: Operator
    robots: "Hardware | None"
    bridge: "Bridge | None"
    stacks: Mapping[str, Stack]
    hosts: Hosts
    agents: Sequence[AgentInfo]
    metrics: Mapping[str, Metric]
    where: Mapping[str, str]
    radius_m: Mapping[str, float]
    inputs: InputLog
    resolution: Resolution

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.hosts.close()

    def start(self, kernel: Kernel) -> None:
        """Start the federates, or close them all on an error; scenario errors name their place."""
        try:
            with _located(self.scenario, self.source):
                kernel.start()
        except BaseException:
            with contextlib.suppress(VcmvspError):
                kernel.close()
            raise

    def recorder(
        self,
        mcap: BinaryIO | None,
        tell: Tell = lambda _: None,
        folder: Path | None = None,
        sink: MessageSink | None = None,
    ) -> Recorder:
        """A recorder of this run that writes into the binary stream ``mcap``, with temporary files in a folder.

        ``sink`` also receives the messages of ``mcap``.
        """
        record = self.scenario.record
        return Recorder(
            self.info,
            record_ticks=Ticks.every(record.period_s),
            mcap=mcap,
            agents=self.agents,
            radius_m=self.radius_m,
            sensors=record.sensors,
            heard=record.heard,
            world=self.world,
            sink=sink,
            folder=folder,
            tell=tell,
        )

    def resolved(self) -> dict[str, Any]:
        """The resolved scenario (`cosim.assembly.resolved`) with the interventions so far."""
        foreign = {vehicle for vehicle, place in self.where.items() if place == "zenoh"}
        resolved = self.resolution.scenario(self.agents, self.hosts.kinds, foreign)
        if interventions := self.operator.all:
            resolved["intervention"] = msgspec.to_builtins(interventions)
        return resolved

    @property
    def has_outside(self) -> bool:
        """Whether robots, stacks or programs in wall time take part."""
        return self.robots is not None or self.bridge is not None or bool(self.stacks)


class Parts(NamedTuple):
    """Parts of a run whose agents have not joined, for its control station."""

    scenario: Scenario
    source: Source
    world: "World"
    radios: "Sequence[RadioFederate]"
    has_outside: bool  # robots, stacks or programs in wall time take part


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
    built: Callable[["Parts"], None] = lambda _: None,
) -> AssembledRun:
    """Build the federates of a scenario, and wait until all agent hosts have joined.

    Args:
        clock: paces the run (`clock_of`).
        runs: where all agents run, overriding the scenario; ``"here"``: in this process if the scenario names their class.
        listen: endpoint for manually started hosts, overriding ``agents.listen``.
        keys, insecure: admission of hosts on other machines (`cosim.hosts.manager.Hosts`).
        connect: drive the real vehicles, open the bridge and the stacks; False only checks the scenario.
        playback: recorded real vehicles of an earlier run, which replace the robots.
        bridged: recorded inputs of an earlier run, which replace programs and stacks.
        recorded_radio: frame table of an earlier run, whose outcomes are repeated.
        watch: called while waiting for hosts; returns a reason to give up, or None.
        built: called once with the parts of the run, before it waits for its agents.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a host or an agent failed.
    """
    resolution, inputs = Resolution(scenario, source), InputLog()
    clock = clock or SimClock()
    wall = clock if isinstance(clock, WallClock) else WallClock()  # unused when a scenario is only checked
    world, resolution.tables["world"] = worlds.build(
        scenario.world, source, seed=scenario.seed, portable=resolution.portable, keep=resolution.keep
    )
    bridges = bool(scenario.bridge.doors) and bridged is None
    airs = radio.federates_of(
        scenario, source, resolution, solids=world.solids, recorded=recorded_radio, programs=bridges, tell=tell
    )
    fleet = Fleet(scenario, source, resolution)
    radius_m = {name: model.radius_m for name, model in fleet.models.items()}
    stacked = stacks.of_scenario(scenario, source, resolution, fleet.models, fleet.sensors, tell=tell)
    placement = Placement(scenario, source, fleet, dict(objects or {}), runs, stacked.place)
    real = real_vehicles.of_scenario(scenario, source, resolution, fleet.models)
    robots = None
    if real and playback is None:
        robots = real_vehicles.robots(
            real, fleet.models, run=scenario.name, clock=wall, tell=tell, log=inputs.on, connect=connect
        )
    outside = playback or robots
    programs = bridge.of_scenario(
        scenario, source, resolution, airs=airs, clock=wall, bridged=bridged, tell=tell, log=inputs.on, connect=connect
    )
    flown = firmware.of_scenario(scenario, source, resolution, fleet.models, tell=tell)
    physics = _physics(scenario, resolution, tell, world=world, vehicles=fleet.specs(), outside=outside, firmware=flown)
    operator = _operator(scenario, source, physics, airs)
    energy = _energy(scenario, source, fleet, getattr(physics, "gravity", GRAVITY))
    metrics = _own_metrics(scenario, source, resolution)
    live = robots is not None or programs.bridge is not None or bool(stacked.by_place)
    built(Parts(scenario, source, world, airs, has_outside=live))
    about = {"scenario": scenario.name, "seed": scenario.seed, "duration_s": scenario.duration_s, "vehicles": [*radius_m]}
    hosts = Hosts(
        scenario.agents,
        _local_hosts(stacked.by_place, inputs, bridged if bridged or connect else ()),
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
        for line in remarks(scenario, resolution.tables["radio"], fleet.models, agents):
            tell(line)
    except BaseException:
        hosts.close()
        raise
    outsiders = [each for each in (programs.in_run_time, programs.bridge, programs.playback, outside) if each is not None]
    others = outsiders if energy is None else [energy, *outsiders]
    # Of several radios, frames that end at the same time would be in another order.
    airs[0].looks_ahead = len(airs) == 1 and not (outsiders or stacked.by_place or scenario.intervention or scenario.routing)
    return AssembledRun(
        scenario=scenario,
        source=source,
        clock=clock,
        info=_info(scenario, fleet, agents),
        federates=[physics, *airs, operator, *hosts.federates, *others],
        world=world,
        radios=airs,
        operator=operator,
        robots=robots,
        bridge=programs.bridge,
        stacks=stacked.by_place,
        hosts=hosts,
        agents=agents,
        metrics=metrics,
        where=placement.where,
        radius_m=radius_m,
        inputs=inputs,
        resolution=resolution,
    )


def _local_hosts(
    by_place: Mapping[str, Stack], inputs: InputLog, recorded: Sequence[Input] | None
) -> dict[str, Callable[..., Any]]:
    """Makers of the hosts in this process by place: of agents, and of stacks or of what earlier ones answered."""
    from vcmvsp.agents.driven_host import DrivenHost
    from vcmvsp.agents.federate import AgentHost
    from vcmvsp.agents.stack_host import RecordedStack, StackHost

    makers: dict[str, Callable[..., Any]] = {"inprocess": AgentHost, "driven": DrivenHost}
    for place, stack in by_place.items():
        used = stack if recorded is None else RecordedStack(stack.vehicles, recorded)
        makers[place] = partial(StackHost, stack=used, log=inputs.on)
    return makers


GRAVITY = 9.81  # m/s2, of physics without such a key
NO_DRAG = (0.0, 0.0, 0.0)
SLOWEST = 1e-6
"""Lowest speed, simulated seconds per wall second; the highest is its inverse."""


def clock_of(scenario: Scenario, speed: float | None, *, replayed: bool) -> Clock:
    """The clock of a run: the wall clock if a speed is given or a robot, program or stack in wall time takes part.

    Args:
        scenario: defines the robots, programs and stacks.
        speed: simulated seconds per wall second; None: as fast as possible, or 1 with robots or programs.
        replayed: robots and programs come from a recording, which needs no wall clock.
    """
    if speed is not None and not SLOWEST <= speed <= 1.0 / SLOWEST:
        problem = f"must be from {SLOWEST:g} to {1.0 / SLOWEST:g}; leave it out to run as fast as possible"
        raise UsageError(f"--realtime {speed:g}: {problem}")
    if scenario.real and not replayed and speed not in (None, 1.0):
        names = ", ".join(scenario.real)
        raise UsageError(f"--realtime {speed:g}: real vehicles ({names}) need speed 1")
    live = not replayed and (scenario.real or scenario.bridge.doors or stacks.paced(scenario))
    return WallClock(speed or 1.0) if live or speed is not None else SimClock()


@contextlib.contextmanager
def _located(scenario: Scenario, source: Source) -> Iterator[None]:
    """Add the line or ``--set`` argument to an error of a part, which knows only the key."""
    try:
        yield
    except ScenarioError as error:
        if error.source and error.source != source.name:
            raise  # the error is in a file that the scenario names
        key = error.key
        if key in {f"vehicle.{each.name}.position" for each in scenario.vehicle if each.pose is not None}:
            key = f"{key.removesuffix('position')}pose"  # the scenario's name of the key
        raise source.error(error.problem, key) from error


def default_engine() -> str:
    """Physics of a scenario that names none: Bullet, or MuJoCo where only that is installed."""
    return "mujoco" if find_spec("pybullet") is None and find_spec("mujoco") is not None else "bullet"


def _physics(scenario: Scenario, resolution: Resolution, tell: Tell, *, firmware: object, **arguments: object) -> Federate:
    if firmware is not None:  # a kind of the user's own need not know it
        arguments["firmware"] = firmware
    content = {"kind": default_engine(), **scenario.physics}
    if "kind" not in scenario.physics and content["kind"] != "bullet":
        tell(f'PyBullet is not installed: physics.kind is "{content["kind"]}"')
    physics: Federate
    physics, resolution.tables["physics"] = resolution.component("physics", content, "physics", arguments=arguments)
    return physics


def _energy(scenario: Scenario, source: Source, fleet: Fleet, gravity: float) -> Federate | None:
    """The batteries of the vehicles that have one; None: no vehicle has."""
    tables = {each.name: each.battery for each in scenario.vehicle if each.battery is not None}
    if not tables:
        return None
    from vcmvsp.physics.energy import Energy, flight_power, rolling_power
    from vcmvsp.physics.vehicles.specification import flies
    from vcmvsp.physics.vehicles.station import FixedStation

    batteries = {}
    for name, table in tables.items():
        model = fleet.models[name]
        if isinstance(model, FixedStation):
            batteries[name] = table, rolling_power(table, 0.0, gravity)
            continue

        def number(key: str, vehicle: str = name, model: Any = model, table: Any = table) -> float:
            value: float | None = getattr(table, key) or getattr(model, key, None)
            if value is None:
                problem = f"is needed here: the kind {type(model).__name__} has none"
                raise source.error(problem, f"vehicle.{vehicle}.battery.{key}")
            return value

        mass_kg = number("mass_kg")
        if flies(model):
            drag = getattr(model, "drag", NO_DRAG)
            batteries[name] = table, flight_power(table, mass_kg, number("rotor_radius_m"), drag, gravity)
        else:
            batteries[name] = table, rolling_power(table, mass_kg, gravity)
    return Energy(batteries)


def _operator(scenario: Scenario, source: Source, physics: Federate, airs: "Sequence[RadioFederate]") -> Operator:
    planned, vehicles = scenario.intervention, [each.name for each in scenario.vehicle]
    check = checks(vehicles, getattr(physics, "check_move", nothing_moves), radio.check_of_changes(airs))
    check_planned(planned, check, source)
    return Operator(planned, vehicles, check)


def _own_metrics(scenario: Scenario, source: Source, resolution: Resolution) -> dict[str, Metric]:
    metrics: dict[str, Metric] = {}
    vehicles = {each.name for each in scenario.vehicle}
    for name, table in scenario.metrics.own.items():
        key = f"metrics.own.{name}"
        metrics[name], resolution.metrics[name] = resolution.component("metric", {"kind": "note", **table}, key, guard=maker_of)
        for vehicle in getattr(metrics[name], "vehicles", ()):
            if vehicle not in vehicles:
                raise source.error(unknown("vehicle", vehicle, vehicles), f"{key}.vehicles")
    return metrics


def _info(scenario: Scenario, fleet: Fleet, agents: Sequence[AgentInfo]) -> RunInfo:
    from vcmvsp.physics.vehicles.station import FixedStation

    read = {f"{info.vehicle}/{name}" for info in agents for name in info.sensors}
    periods_s = {info.vehicle: float(info.ticks.period) / SECOND_NS for info in agents}
    clocks = {each.name: each.clock for each in scenario.vehicle if each.clock is not None}
    stations = [name for name, model in fleet.models.items() if isinstance(model, FixedStation)]
    return RunInfo(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_ns=seconds_to_ns(scenario.duration_s),
        vehicles=tuple(fleet.models),
        instants=_instants(scenario, agents),
        wanted=tuple(sorted(read | fleet.recorded())),
        periods_s=periods_s,
        clocks=clocks,
        radios=scenario.radio_members,
        stations=tuple(stations),
    )


def _instants(scenario: Scenario, agents: Sequence[AgentInfo]) -> tuple[Instants, ...]:
    """Times at which states are needed: agents' ticks, effects of their commands, recorded instants."""
    tables = {each.name: each.agent for each in scenario.vehicle}
    trains = [Instants(Ticks.every(scenario.record.period_s), 0, "record.period_s")]
    for info in agents:
        for name, offset_ns in (("period_s", 0), ("latency_s", info.latency_ns)):
            own = getattr(tables[info.vehicle], name, None) is not None
            key = f"vehicle.{info.vehicle}.agent.{name}" if own else f"agents.{name}"
            trains.append(Instants(info.ticks, offset_ns, key))
    return tuple({(each.ticks, each.offset_ns): each for each in reversed(trains)}.values())
