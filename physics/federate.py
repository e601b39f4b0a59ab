"""The physics federate: applies commands, advances the vehicles, and publishes their true states and their estimates.

`Physics` is the same for every engine. `KinematicPhysics` moves all vehicles without bodies. `BulletPhysics` gives bodies to
differential drives and quadrotors, and moves all other vehicles like `KinematicPhysics`: nothing collides with them.

Inputs take effect at their own times: ``<vehicle>/command``, ``operator/halted`` (vehicles stand still until they are
released, then follow their newest commands) and ``operator/moved`` (a movable is put elsewhere).

Outputs at every requested instant (`RunInfo.instants`, the start and the end):

======================  ============  =======================================================================
``world/states``        States        true states, for the radio and the recording
``<vehicle>/estimate``  VehicleState  the vehicle's estimate of its own state
``<vehicle>/odometry``  Odometry      wheel odometry, for vehicles with wheels
``world/contact``       Contact       contacts of two bodies, or of a body and a solid, since the last instant
``world/pushed``        Pushed        poses of the movables, after every change
======================  ============  =======================================================================

Sensors publish at their own ticks: ``<vehicle>/fix`` for a positioning sensor, ``<vehicle>/<sensor>`` for all others.

External vehicles (`cosim.federate.ExternalMotion`) are included in all of this, except ``estimate``, ``odometry`` and
``fix``, which another federate publishes.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, ExternalMotion, FlightFirmware, Instants, Needed, RunInfo, Slot, Step
from vcmvsp.cosim.types import Array, Halted, Moved, NonNegative, Rate, States, Vec3, Velocity, Waypoint
from vcmvsp.physics import placement_checks as checks
from vcmvsp.physics.dynamics.engine import BodyMotion, Commands, Contacts, Engine, FirmwareMover, FleetEngine, Mover, gathered
from vcmvsp.physics.dynamics.firmware_pilot import LEAST_HZ, FirmwarePilot
from vcmvsp.physics.dynamics.free_flight import FreeFlightEngine
from vcmvsp.physics.dynamics.kinematic import AerialEngine, ExternalEngine, GroundEngine, StationEngine
from vcmvsp.physics.dynamics.wind import Gusts
from vcmvsp.physics.pose_sources import PoseSources
from vcmvsp.physics.scene_builder import SceneBuilder
from vcmvsp.physics.sensor_scheduler import SensorScheduler
from vcmvsp.physics.vehicles.models import DifferentialDrive, GroundVehicle, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec, flies
from vcmvsp.physics.vehicles.station import FixedStation
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World

PACE = Ticks.every(1 / 64)
"""Steps ahead of need of an engine with steps of its own, in a run paced by the wall clock: instants then start in time."""
SOON_S = 0.2  # longest delay between a placement check and the placement


class Physics:
    """Base of all physics federates; a subclass chooses the engines.

    All take the same keys, so that a scenario can switch ``physics.kind`` alone. Without bodies, the last three have no effect.

    Args:
        world: floor, solids, and what else is in it.
        vehicles: all vehicles with their start poses.
        rate_hz: Bullet steps a second. Every instant at which states or readings are needed must fall on a step.
        iterations: of Bullet's constraint solver in each step; fewer are quicker, and drift more.
        gravity: m/s2.
        outside: motion of the external vehicles. It comes from the program, not from the scenario.
        firmware: flies some quadrotors, in place of their own autopilots. It comes from the program, too.
    """

    name = "physics"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    reads: tuple[str, ...] = ("*/command", "operator/halted", "operator/moved")
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(
        self,
        *,
        world: World,
        vehicles: Sequence[VehicleSpec],
        rate_hz: Rate = 120.0,
        iterations: Annotated[int, msgspec.Meta(ge=1)] = 50,
        gravity: NonNegative = 9.81,
        outside: ExternalMotion | None = None,
        firmware: FlightFirmware | None = None,
    ) -> None:
        self.rate_hz, self.iterations, self.gravity = rate_hz, iterations, gravity
        self.world, self.vehicles = world, tuple(vehicles)
        self._names = tuple(spec.name for spec in self.vehicles)
        self._outside, self._firmware = outside, firmware
        self.waits = firmware is not None  # Ctrl-C may interrupt an exchange with firmware
        names = () if outside is None else outside.names
        self._external = [number for number, name in enumerate(self._names) if name in names]
        self._simulated = [number for number, name in enumerate(self._names) if name not in names]
        self._external_engine: ExternalEngine | None = None
        self._engines: list[tuple[Engine, Array]] = []

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """Engines at time 0, each with the numbers of its vehicles."""
        raise NotImplementedError

    def start(self, run: RunInfo) -> int:
        """Build the engines; the first publication is at 0.

        Raises:
            ScenarioError: names, places, sensors, instants or kinds of vehicles are impossible; with the key.
        """
        self._run, self._now_ns = run, 0
        self._scenes = SceneBuilder(self.world, self.vehicles, self.gravity)
        external = [self.vehicles[number] for number in self._external]
        if self._outside and self._outside.names:
            self._external_engine = ExternalEngine(self._outside, external)
        self._sources = PoseSources(self.vehicles, self._simulated, run.seed)
        self._sensors = SensorScheduler({spec.name: spec.sensors for spec in self.vehicles}, run.seed, requested=run.wanted)
        own = (*self._sensors.instants, *self._sources.instants, *([Instants(PACE)] if run.paced else []))
        self._needed, self._stops = Needed(run), Needed(msgspec.structs.replace(run, instants=(*run.instants, *own)))
        checks.check_names(self.world, self.vehicles)
        checks.check_places(self.world, self.vehicles)
        checks.check_sensors(self.vehicles, [spec.name for spec in external])
        self._engines = [(engine, np.array(numbers, int)) for engine, numbers in self.engines()]
        for engine, _ in self._engines:
            engine.expect(run.duration_ns, now=run.paced)
        self._commands = Commands(self._movers(), self._advance)
        self._contacts = Contacts(self._engines, len(self.vehicles), self._scenes.names)
        self._sources.feed(0, self._motion())
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Apply each command from its own time on, up to now; then publish."""
        self._apply(inbox)
        states, readings = self._needed.hits(now_ns), self._sensors.due(now_ns)
        if states or readings or self._sources.due(now_ns):
            self._advance(now_ns)
            return Step(self._publish(now_ns, states=states, readings=readings), self._stops.after(now_ns))
        self._feed(now_ns)
        for engine, _ in self._engines:  # work ahead of the next publication
            if engine.stepped:
                engine.advance(now_ns)
        return Step((), self._stops.after(now_ns))

    def close(self) -> None:
        """Release the engines."""
        for engine, _ in self._engines:
            engine.close()
        if self._firmware is not None:
            self._firmware.close()

    def check_move(self, obstacle: str, position: tuple[float, float], yaw: float) -> None:
        """Refuse an impossible place, x, y m and yaw rad, for the movable of a name. Before the start, vehicles are ignored.

        Raises:
            ValueError: there is no such movable, or no room for it there.
        """
        number, place = checks.placed(self.world, obstacle, position, yaw)
        if self._engines:
            self._check_free(number, place, yaw, SOON_S)

    def _movers(self) -> dict[str, Mover | FirmwareMover]:
        movers: dict[str, Mover | FirmwareMover] = {}
        for engine, numbers in self._engines:
            for row, number in enumerate(numbers.tolist()):
                if number in self._simulated:
                    name = self._names[number]
                    movers[name] = Mover(engine, row, flies(self.vehicles[number].model))
                    if self._firmware is not None and name in self._firmware.names:
                        movers[name] = FirmwareMover(self._firmware, name)
        for number in self._simulated:
            name = self._names[number]
            if name not in movers:
                problem = f"{name} is a {type(self.vehicles[number].model).__name__}, a model without an engine: "
                raise ScenarioError(f"{problem}derive it from GroundVehicle, Point or Quadrotor", key=f"vehicle.{name}.kind")
        return movers

    def _check_free(self, number: int, place: Vec3, yaw: float, within_s: float) -> None:
        scene = self._scenes.scene(self._now_ns, self._motion(), self._movables(), ())
        checks.check_free(scene, self._scenes.names, len(self.vehicles) + number, place, yaw, within_s)

    def _apply(self, inbox: Sequence[Event]) -> None:
        for event in inbox:
            match event.value:
                case Velocity() | Waypoint() as command:
                    self._commands.take(event.key, event.time_ns, command)
                case Halted(vehicles=vehicles, halted=halted):
                    self._commands.halt(vehicles, event.time_ns, halted=halted)
                case Moved(obstacle=obstacle, position=position, yaw=yaw):
                    self._advance(event.time_ns)
                    self._put(obstacle, position, yaw)

    def _put(self, obstacle: str, position: tuple[float, float], yaw: float) -> None:
        try:
            number, place = checks.placed(self.world, obstacle, position, yaw)
            self._check_free(number, place, yaw, 0.0)  # an engine throws overlapping bodies apart
        except ValueError as error:
            raise FederateError(self.name, str(error)) from error
        self._scenes.put(number, place, yaw)
        for engine, _ in self._engines:
            engine.put(number, place, yaw)

    def _advance(self, to_ns: int) -> None:
        self._feed(to_ns)
        self._move(to_ns)

    def _feed(self, to_ns: int) -> None:
        """Feed the estimators at each of their instants up to ``to_ns``, and advance to the last of these."""
        while (fed_ns := self._sources.next_fed_ns(self._now_ns)) is not None and fed_ns <= to_ns:
            self._move(fed_ns)
            self._sources.feed(fed_ns, self._motion())

    def _move(self, to_ns: int) -> None:
        if to_ns > self._now_ns:
            self._now_ns = to_ns
            for engine, _ in self._engines:
                engine.advance(to_ns)

    def _motion(self) -> BodyMotion:
        return gathered([(engine.read(), rows) for engine, rows in self._engines], len(self.vehicles))

    def _publish(self, now_ns: int, *, states: bool, readings: bool) -> list[Event]:
        if self._external_engine:
            self._external_engine.update(now_ns)
        motion = self._motion()
        events = []
        if states:
            position, velocity, attitude, spin, *_ = motion
            value = States(names=self._names, position=position, velocity=velocity, attitude=attitude, angular_velocity=spin)
            events.append(Event("world/states", now_ns, value))
        events += self._sources.measure(now_ns, motion)
        if readings:
            scene = self._scenes.scene(now_ns, motion, self._movables(), self._contacts.now(passing=False))
            events += self._sensors.read(scene)
        if states:
            events += self._sources.estimates(now_ns, motion) + self._contacts.begun(now_ns)
            if self._firmware is not None:
                events += [Event(f"{name}/incident", now_ns, each) for name, each in self._firmware.incidents()]
            if self.world.movables and (pushed := self._scenes.pushed(self._movables())):
                events.append(Event("world/pushed", now_ns, pushed))
        return events

    def _movables(self) -> BodyMotion | None:
        """Motion of the movables; None: no engine can push them."""
        for engine, _ in self._engines:
            movables = engine.movables()
            if len(movables.position):
                return movables
        return None

    def _fly_by_firmware(self, engine: FleetEngine, specs: Sequence[VehicleSpec]) -> None:
        """Give quadrotors of an engine, by the rows of its fleet, to their firmware if they have one."""
        if self._firmware is None:
            return
        if self.rate_hz < LEAST_HZ:
            problem = f"firmware needs at least {LEAST_HZ:g} steps a second, not {self.rate_hz:g}: 250 suit PX4, 400 ArduPilot"
            raise ScenarioError(problem, key="physics.rate_hz")
        FirmwarePilot(
            self._firmware,
            engine.fleet,
            specs,
            world=self.world,
            gravity=self.gravity,
            rate_hz=self.rate_hz,
            seed=self._run.seed,
        )

    def _bodiless(self, numbers: Sequence[int]) -> list[tuple[Engine, list[int]]]:
        """Engines without bodies: on the ground, in the air, of stations, external; each with its numbered vehicles."""
        makers: list[tuple[Any, Callable[..., Engine]]] = [
            (GroundVehicle, partial(GroundEngine, sensed=any(spec.sensors for spec in self.vehicles))),
            (Point | Quadrotor, AerialEngine),
            (FixedStation, StationEngine),
        ]
        engines: list[tuple[Engine, list[int]]] = []
        for kind, make in makers:
            own = [n for n in numbers if n not in self._external and isinstance(self.vehicles[n].model, kind)]
            if own:
                engines.append((make(*_starts([self.vehicles[n] for n in own])), own))
        external = [n for n in numbers if n in self._external]
        if self._external_engine and external:
            engines.append((self._external_engine, external))
        return engines


def _starts(specs: Sequence[VehicleSpec]) -> Iterator[tuple[Any, ...]]:
    """Models, positions, m, and headings, rad, of one vehicle or more."""
    return zip(*((spec.model, spec.start, spec.heading) for spec in specs), strict=True)


class KinematicPhysics(Physics):
    """Every vehicle moves without a body: exactly as commanded, or with the lags and limits of its kind."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """One engine on the ground, one in the air, one for external vehicles."""
        if self._firmware is not None:
            key = f"vehicle.{self._firmware.names[0]}.firmware"
            raise ScenarioError('needs rotors: use physics.kind = "bullet" or "mujoco"', key=key)
        return self._bodiless(range(len(self.vehicles)))


class FlightPhysics(Physics):
    """Quadrotors fly by rotors and autopilots as in Bullet, but nothing has a body; other vehicles as in ``kinematic``."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """The engine of quadrotors, and the engines of vehicles without bodies."""
        checks.check_instants(self._run, self.rate_hz, self._sources.instants)
        self._sensors.check(Ticks.rate(self.rate_hz))
        flyers = [n for n in self._simulated if isinstance(self.vehicles[n].model, Quadrotor)]
        specs = [self.vehicles[n] for n in flyers]
        checks.check_lift(specs, self.gravity)
        engines = self._bodiless([n for n in range(len(self.vehicles)) if n not in flyers])
        if flyers:
            wind = Gusts(self.world.wind, [spec.name for spec in specs], self._run.seed).advance
            engine = FreeFlightEngine(*_starts(specs), wind=wind, rate_hz=self.rate_hz, gravity=self.gravity)
            engines.append((engine, flyers))
            self._fly_by_firmware(engine, specs)
        return engines


class RigidBodyPhysics(Physics):
    """Base of physics with bodies: differential drives and quadrotors are bodies, other vehicles move without."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """The engine with bodies, and the engines of vehicles without bodies."""
        checks.check_instants(self._run, self.rate_hz, self._sources.instants)
        self._sensors.check(Ticks.rate(self.rate_hz))
        rigid = DifferentialDrive | UrdfDrive | Quadrotor
        bodies = [n for n, spec in enumerate(self.vehicles) if n in self._external or isinstance(spec.model, rigid)]
        specs = [self.vehicles[n] for n in bodies]
        checks.check_overlaps(self.world, specs)
        simulated = [self.vehicles[n] for n in bodies if n not in self._external]
        checks.check_lift(simulated, self.gravity)
        engine = self._engine(
            world=self.world,
            vehicles=specs,
            seed=self._run.seed,
            rate_hz=self.rate_hz,
            gravity=self.gravity,
            accelerations=any(spec.sensors for spec in specs),
            external=self._external_engine,
        )
        self._fly_by_firmware(engine, [spec for spec in simulated if isinstance(spec.model, Quadrotor)])
        return [(engine, bodies), *self._bodiless([n for n in range(len(self.vehicles)) if n not in bodies])]

    def _engine(self, **arguments: Any) -> FleetEngine:
        """The engine with bodies."""
        raise NotImplementedError


class BulletPhysics(RigidBodyPhysics):
    """Differential drives and quadrotors are bodies in Bullet; vehicles of other kinds move without bodies."""

    def _engine(self, **arguments: Any) -> FleetEngine:
        try:
            from vcmvsp.physics.dynamics.bullet.engine import BulletEngine  # loads PyBullet, 0.4 s
        except ModuleNotFoundError as error:  # Python 3.14
            raise ScenarioError('needs PyBullet, which is not installed: use "mujoco"', key="physics.kind") from error
        return BulletEngine(**arguments, iterations=self.iterations)


class MujocoPhysics(RigidBodyPhysics):
    """Differential drives and quadrotors are bodies in MuJoCo; vehicles of other kinds move without bodies."""

    def _engine(self, **arguments: Any) -> FleetEngine:
        try:
            from vcmvsp.physics.dynamics.mujoco.engine import MujocoEngine
        except ModuleNotFoundError as error:
            raise ScenarioError("needs MuJoCo: pip install 'vcmvsp[mujoco]'", key="physics.kind") from error
        return MujocoEngine(**arguments)
