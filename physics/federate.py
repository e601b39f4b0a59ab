"""The physics federate: takes commands, advances the vehicles, publishes what is true and what each vehicle may know of it.

`Physics` is the same for every engine. `KinematicPhysics` moves all vehicles without bodies; `BulletPhysics` gives a body to
those that can have one and moves the others as `KinematicPhysics` would: nothing collides with them.

Taken at the next step, each from its own time on: ``<vehicle>/command``, ``operator/halted`` (vehicles stand still until they
are let go, when their newest commands count again) and ``operator/moved`` (a movable stands somewhere else).

Published at every instant that somebody asked for (`RunInfo.instants`, the start and the end):

======================  ============  =======================================================================
``world/states``        States        the truth, for the radio and the recording
``<vehicle>/estimate``  VehicleState  what the vehicle takes for its own state
``<vehicle>/odometry``  Odometry      what its wheels say, if it has any
``world/contact``       Contact       when two bodies, or a body and a solid, touch that did not at the last instant
``world/pushed``        Pushed        where the movables are, whenever that has changed
======================  ============  =======================================================================

and what sensors say, at their own ticks: ``<vehicle>/fix`` of a positioning sensor, ``<vehicle>/<sensor>`` of all others.

Vehicles that something else moves (`cosim.federate.ExternalMotion`) are in all of this, but for ``estimate``, ``odometry``
and ``fix``: these are published by whoever moves them.
"""

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, ExternalMotion, Instants, Needed, RunInfo, Slot, Step
from vcmvsp.cosim.types import Array, Halted, Moved, NonNegative, Rate, States, Vec3, Velocity, Waypoint
from vcmvsp.physics.bodiless_engines import riders
from vcmvsp.physics.dynamics.external_vehicles import Reflected, check_shown
from vcmvsp.physics.engine.commands import Commands
from vcmvsp.physics.engine.contacts import Contacts
from vcmvsp.physics.engine.interface import Engine, Motion, gathered
from vcmvsp.physics.initial_checks import check_instants, check_lift, check_names, check_overlaps, check_places, check_sensors
from vcmvsp.physics.move_checks import check_free, placed
from vcmvsp.physics.pose_sources import PoseSources
from vcmvsp.physics.scene_builder import Stage
from vcmvsp.physics.sensor_scheduler import Instruments
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.quadrotor import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec, flies
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World

PACE = Ticks.every(1 / 64)
"""How often an engine with steps of its own moves on where the wall clock paces the run, so that instants begin in time."""
SOON_S = 0.2  # from asking whether a place is free to putting something there, at most


class Physics:
    """What all physics federates do; a subclass says which engine moves which vehicles.

    All take the same keys, so that a scenario can switch ``physics.kind`` alone; where no vehicle has a body, the last three
    change nothing.

    Args:
        world: floor, solids, and what else is in it.
        vehicles: what moves, and where it starts.
        rate_hz: Bullet steps a second. Every instant at which states or readings are needed must fall on one.
        iterations: of Bullet's constraint solver in each step; fewer are quicker, and drift more.
        gravity: m/s2.
        outside: moves the vehicles that it names; they are shown, and nothing moves them here. It comes from the program, not
            from the scenario.
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
    ) -> None:
        self.rate_hz, self.iterations, self.gravity = rate_hz, iterations, gravity
        self.world, self.vehicles = world, tuple(vehicles)
        self._names = tuple(spec.name for spec in self.vehicles)
        self._outside = outside
        names = () if outside is None else outside.names
        self._shown = [number for number, name in enumerate(self._names) if name in names]
        self._moved = [number for number, name in enumerate(self._names) if name not in names]
        self._reflected: Reflected | None = None
        self._engines: list[tuple[Engine, Array]] = []

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """Engines at time 0, and the numbers of the vehicles that each of them moves or shows."""
        raise NotImplementedError

    def start(self, run: RunInfo) -> int:
        """Build the engines; the first publication is at 0.

        Raises:
            ScenarioError: with the key of what cannot be: names, places, sensors, instants, kinds of vehicles.
        """
        self._run, self._now_ns = run, 0
        self._stage = Stage(self.world, self.vehicles, self.gravity)
        shown = [self.vehicles[number] for number in self._shown]
        self._reflected = Reflected(self._outside, shown) if self._outside and self._outside.names else None
        self._sources = PoseSources(self.vehicles, self._moved, run.seed)
        fitted = {spec.name: spec.sensors for spec in self.vehicles}
        self._instruments = Instruments(fitted, run.seed, wanted=frozenset(run.wanted))
        own = (*self._instruments.instants, *self._sources.instants, *([Instants(PACE)] if run.paced else []))
        self._needed, self._stops = Needed(run), Needed(msgspec.structs.replace(run, instants=(*run.instants, *own)))
        check_names(self.world, self.vehicles)
        check_places(self.world, self.vehicles)
        check_sensors(self.vehicles)
        check_shown(shown)
        self._engines = [(engine, np.array(numbers, int)) for engine, numbers in self.engines()]
        mover = {
            self._names[number]: (engine, row, flies(self.vehicles[number].model))
            for engine, numbers in self._engines
            for row, number in enumerate(numbers.tolist())
            if number in self._moved
        }
        for spec in (self.vehicles[number] for number in self._moved):
            if spec.name not in mover:
                problem = f"{spec.name} is a {type(spec.model).__name__}, which physics cannot move: "
                problem += "derive it from GroundVehicle, Point or Quadrotor"
                raise ScenarioError(problem, key=f"vehicle.{spec.name}.kind")
        self._commands = Commands(mover, self._advance)
        self._contacts = Contacts(self._engines, len(self.vehicles), self._stage.names)
        self._sources.feed(0, self._motion())
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Obey every command from its own time on, up to now; then publish."""
        self._take(inbox)
        asked, sensing = self._needed.hits(now_ns), self._instruments.due(now_ns)
        if asked or sensing or self._sources.due(now_ns):
            self._advance(now_ns)
            return Step(self._publish(now_ns, asked=asked, sensing=sensing), self._stops.after(now_ns))
        self._feed(now_ns)
        for engine, _ in self._engines:  # what is done now need not be done when something is due
            if engine.stepped:
                engine.advance(now_ns)
        return Step((), self._stops.after(now_ns))

    def close(self) -> None:
        """Release the engines."""
        for engine, _ in self._engines:
            engine.close()

    def check_move(self, obstacle: str, position: tuple[float, float], yaw: float) -> None:
        """Refuse to put a movable where it cannot stand; changes nothing. Before the start, vehicles are not looked at.

        Args:
            obstacle: its name.
            position: where, x, y m, world.
            yaw: rad.

        Raises:
            ValueError: there is no such movable, or no room for it there.
        """
        number, place = placed(self.world, obstacle, position, yaw)
        if self._engines:
            self._check_free(number, place, yaw, SOON_S)

    def _check_free(self, number: int, place: Vec3, yaw: float, within_s: float) -> None:
        scene = self._stage.scene(self._now_ns, self._motion(), self._movables(), ())
        check_free(scene, self._stage.names, len(self.vehicles) + number, place, yaw, within_s)

    def _take(self, inbox: Sequence[Event]) -> None:
        """Advance to the time of each command, and of what the operator does, and obey it from there on."""
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
            number, place = placed(self.world, obstacle, position, yaw)
            self._check_free(number, place, yaw, 0.0)  # an engine would fling them apart
        except ValueError as error:
            raise FederateError(self.name, str(error)) from error
        self._stage.put(number, place, yaw)
        for engine, _ in self._engines:
            engine.put(number, place, yaw)

    def _advance(self, to_ns: int) -> None:
        """Move on, and feed the estimators on the way."""
        self._feed(to_ns)
        self._move(to_ns)

    def _feed(self, to_ns: int) -> None:
        """Move on to the last instant up to ``to_ns`` at which estimators are fed, and feed them at each."""
        while (fed_ns := self._sources.next_fed_ns(self._now_ns)) is not None and fed_ns <= to_ns:
            self._move(fed_ns)
            self._sources.feed(fed_ns, self._motion())

    def _move(self, to_ns: int) -> None:
        if to_ns > self._now_ns:
            self._now_ns = to_ns
            for engine, _ in self._engines:
                engine.advance(to_ns)

    def _motion(self) -> Motion:
        """How all vehicles move now."""
        return gathered([(engine.read(), rows) for engine, rows in self._engines], len(self.vehicles))

    def _publish(self, now_ns: int, *, asked: bool, sensing: bool) -> list[Event]:
        """Everything of this instant, vehicles in the scenario's order: states if ``asked`` for, readings if ``sensing``."""
        if self._reflected:
            self._reflected.ask(now_ns)
        motion = self._motion()
        events = []
        if asked:
            states = States(
                names=self._names,
                position=motion.position,
                velocity=motion.velocity,
                attitude=motion.attitude,
                angular_velocity=motion.angular_velocity,
            )
            events.append(Event("world/states", now_ns, states))
        events += self._sources.measure(now_ns, motion)
        if sensing:
            scene = self._stage.scene(now_ns, motion, self._movables(), self._contacts.now(passing=False))
            events += self._instruments.read(scene)
        if asked:
            events += self._sources.estimates(now_ns, motion) + self._contacts.begun(now_ns)
            events += self._pushes(now_ns) if self.world.movables else []
        return events

    def _pushes(self, now_ns: int) -> list[Event]:
        """Where movables are, if that is not where they were told to be last."""
        pushed = self._stage.pushed(self._movables())
        return [] if pushed is None else [Event("world/pushed", now_ns, pushed)]

    def _movables(self) -> Motion | None:
        """How movables move now; None: nothing can push them."""
        found = [each for engine, _ in self._engines for each in (engine.movables(),) if len(each.position)]
        return found[0] if found else None


class KinematicPhysics(Physics):
    """Every vehicle moves without a body: exactly as commanded, or with the lags and limits of its kind."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """One engine on the ground, one in the air, one for what is only shown."""
        moved = riders(self.vehicles, self._moved)
        return [*moved, (self._reflected, self._shown)] if self._reflected else moved


class BulletPhysics(Physics):
    """Differential drives and quadrotors are bodies in Bullet; vehicles of other kinds ride along without one."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """Bullet for those with a body, the others as without it."""
        from vcmvsp.physics.dynamics.bullet.engine import (
            BulletEngine,  # loads PyBullet: 0.4 s that a kinematic run need not wait
        )

        check_instants(self._run, self.rate_hz, self._sources.instants)
        self._instruments.check(Ticks.rate(self.rate_hz))
        solid = DifferentialDrive | UrdfDrive | Quadrotor
        bodies = [n for n, spec in enumerate(self.vehicles) if n in self._shown or isinstance(spec.model, solid)]
        specs = [self.vehicles[n] for n in bodies]
        check_overlaps(self.world, specs)
        check_lift([self.vehicles[n] for n in bodies if n not in self._shown], self.gravity)
        bullet = BulletEngine(
            world=self.world,
            models=[spec.model for spec in specs],
            positions=[spec.start for spec in specs],
            headings=[spec.heading for spec in specs],
            names=[spec.name for spec in specs],
            seed=self._run.seed,
            rate_hz=self.rate_hz,
            iterations=self.iterations,
            gravity=self.gravity,
            accelerations=any(spec.sensors for spec in specs),
            reflected=self._reflected,
        )
        return [(bullet, bodies), *riders(self.vehicles, [n for n in range(len(self.vehicles)) if n not in bodies])]
