"""The physics federate: takes commands, advances the vehicles, publishes what is true and what each vehicle may know of it.

`Physics` is the same for every engine. `KinematicPhysics` moves all vehicles without bodies; `BulletPhysics` gives a body to
those that can have one and moves the others as `KinematicPhysics` would: nothing collides with them.

Published at every instant that somebody asked for (`RunInfo.instants`, the ticks of a positioning sensor, the end):

======================  ============  =======================================================================
``world/states``        States        the truth, for the radio and the recording
``<vehicle>/fix``       Fix           at the ticks of its positioning sensor only
``<vehicle>/estimate``  VehicleState  what the vehicle takes for its own state
``<vehicle>/odometry``  Odometry      what its wheels say
``world/contact``       Contact       when two bodies, or a body and a box, touch that did not at the last instant
======================  ============  =======================================================================
"""

from collections.abc import Sequence
from math import isfinite
from typing import Annotated

import msgspec
import numpy as np

from cosim.clock import Ticks
from cosim.errors import FederateError, ScenarioError
from cosim.federate import Event, RunInfo, Slot, Step
from cosim.frames import quaternion_from_yaw
from cosim.rng import stream
from cosim.types import Contact, Fix, NonNegative, Odometry, Rate, States, VehicleState, Velocity, frozen
from physics.engine import Engine
from physics.motion import MotionEngine
from physics.vehicles import DifferentialDrive, VehicleSpec
from physics.world import World


class Physics:
    """What all physics federates do; a subclass says which engine moves which vehicles.

    All take the same keys, so that a scenario can switch ``physics.kind`` alone; where no vehicle has a body, the last three
    change nothing.

    Args:
        world: floor and boxes.
        vehicles: what moves, and where it starts.
        rate_hz: Bullet steps a second. Every instant at which states are needed must fall on one.
        iterations: of Bullet's constraint solver in each step; fewer are quicker, and drift more.
        gravity: m/s2.
    """

    name = "physics"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    reads: tuple[str, ...] = ("*/command",)
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
    ) -> None:
        self.rate_hz, self.iterations, self.gravity = rate_hz, iterations, gravity
        self.world, self.vehicles = world, tuple(vehicles)
        self.radius_m = {spec.name: spec.model.radius_m for spec in self.vehicles}
        self._names = tuple(spec.name for spec in self.vehicles)
        self._fixes: list[Fix | None] = [None] * len(self.vehicles)
        self._touching: frozenset[tuple[int, int | None]] = frozenset()
        self._engines: list[tuple[Engine, list[int]]] = []

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """Engines at time 0, and the numbers of the vehicles that each of them moves."""
        raise NotImplementedError

    def start(self, run: RunInfo) -> int:
        """Build the engines; the first publication is at 0."""
        self._run = run
        self._sensors = [
            (number, spec.positioning, Ticks.rate(spec.positioning.rate_hz), stream(run.seed, f"{spec.name}/positioning"))
            for number, spec in enumerate(self.vehicles)
            if spec.positioning is not None
        ]
        trains = [(each.ticks, each.offset_ns) for each in run.instants] + [(ticks, 0) for _, _, ticks, _ in self._sensors]
        self._trains = tuple(dict.fromkeys(trains))  # equal ones once, in order
        self._engines = self.engines()
        self._mover = {
            self._names[number]: (engine, row) for engine, numbers in self._engines for row, number in enumerate(numbers)
        }
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Obey every command from its own time on, up to now; then publish."""
        for event in inbox:
            vehicle = event.key.partition("/")[0]
            if vehicle in self._mover and isinstance(event.value, Velocity):  # others are moved by another federate
                self._command(vehicle, event.time_ns, event.value)
        self._advance(now_ns)
        return Step(self._publish(now_ns), self._next(now_ns))

    def close(self) -> None:
        """Release the engines."""
        for engine, _ in self._engines:
            engine.close()

    def _command(self, vehicle: str, time_ns: int, command: Velocity) -> None:
        """Advance to the command's time and obey it from there on; ground vehicles take its forward speed and yaw rate."""
        v, w = command.linear[0], command.yaw_rate
        if not (isfinite(v) and isfinite(w)):
            raise FederateError(self.name, f"the command of {vehicle} is not finite: {v} m/s, {w} rad/s")
        self._advance(time_ns)
        engine, row = self._mover[vehicle]
        engine.command(row, v, w)

    def _advance(self, to_ns: int) -> None:
        for engine, _ in self._engines:
            engine.advance(to_ns)

    def _next(self, now_ns: int) -> int | None:
        """The first instant after now at which anything is to be published; the end of the run is one."""
        end_ns = self._run.duration_ns
        if now_ns >= end_ns:
            return None
        return min((end_ns, *(ticks.after(now_ns - offset_ns) + offset_ns for ticks, offset_ns in self._trains)))

    def _publish(self, now_ns: int) -> list[Event]:
        """Everything of this instant, vehicles in the scenario's order."""
        rows = self._read()
        states = [state for state, _ in rows]
        events = [Event("world/states", now_ns, self._states(states))]
        for number, sensor, ticks, rng in self._sensors:
            if ticks.hits(now_ns):
                fix = self._fixes[number] = sensor.measure(now_ns, states[number], rng)
                events.append(Event(f"{self._names[number]}/fix", now_ns, fix))
        for number, (spec, (truth, odometry)) in enumerate(zip(self.vehicles, rows, strict=True)):
            estimate = _estimate(spec.pose_source, truth, odometry, self._fixes[number])
            events.append(Event(f"{spec.name}/estimate", now_ns, estimate))
            events.append(Event(f"{spec.name}/odometry", now_ns, odometry))
        return events + [Event("world/contact", now_ns, contact) for contact in self._contacts()]

    def _read(self) -> list[tuple[VehicleState, Odometry]]:
        """State and odometry of every vehicle, in the scenario's order."""
        rows = {n: row for engine, numbers in self._engines for n, row in zip(numbers, engine.read(), strict=True)}
        return [rows[number] for number in range(len(self.vehicles))]

    def _states(self, states: Sequence[VehicleState]) -> States:
        n = len(states)
        return States(
            names=self._names,
            position=frozen(np.array([state.position for state in states], float).reshape(n, 3)),
            velocity=frozen(np.array([state.velocity for state in states], float).reshape(n, 3)),
            attitude=frozen(np.array([state.attitude for state in states], float).reshape(n, 4)),
            angular_velocity=frozen(np.array([state.angular_velocity for state in states], float).reshape(n, 3)),
        )

    def _contacts(self) -> list[Contact]:
        """Contacts that began since the last publication."""
        pairs = [
            (numbers[a], None if b is None else numbers[b]) for engine, numbers in self._engines for a, b in engine.touching()
        ]
        begun = [pair for pair in pairs if pair not in self._touching]
        self._touching = frozenset(pairs)
        return [Contact(vehicle=self._names[a], other=None if b is None else self._names[b]) for a, b in begun]


def _estimate(pose_source: str, truth: VehicleState, odometry: Odometry, fix: Fix | None) -> VehicleState:
    """What a vehicle takes for its own state: the pose by its pose source; speeds by its wheels unless it is told the truth."""
    if pose_source == "truth":
        return truth
    if pose_source == "odometry" or fix is None:
        (x, y, yaw), z = odometry.pose, 0.0
    else:
        (x, y, z), yaw = fix.position, fix.yaw
    w, _, _, s = attitude = quaternion_from_yaw(yaw)
    velocity = (odometry.v * (w * w - s * s), odometry.v * 2.0 * w * s, 0.0)
    return VehicleState(position=(x, y, z), velocity=velocity, attitude=attitude, angular_velocity=(0.0, 0.0, odometry.w))


class KinematicPhysics(Physics):
    """Every vehicle moves without a body: exactly as commanded, or with the lags and limits of its kind."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """One engine for all."""
        return [(MotionEngine(self.vehicles), list(range(len(self.vehicles))))]


class BulletPhysics(Physics):
    """Differential drives are bodies in Bullet; vehicles of other kinds ride along without one."""

    def engines(self) -> list[tuple[Engine, list[int]]]:
        """Bullet for the differential drives, `MotionEngine` for the rest."""
        from physics.bullet import BulletEngine  # loads PyBullet: 0.4 s that a kinematic run need not wait

        self._check_instants()
        bodies = [
            (n, spec.model, spec.pose) for n, spec in enumerate(self.vehicles) if isinstance(spec.model, DifferentialDrive)
        ]
        riders = [n for n, spec in enumerate(self.vehicles) if not isinstance(spec.model, DifferentialDrive)]
        self._check_overlaps(bodies)
        bullet = BulletEngine(
            world=self.world,
            models=[model for _, model, _ in bodies],
            poses=[pose for _, _, pose in bodies],
            rate_hz=self.rate_hz,
            iterations=self.iterations,
            gravity=self.gravity,
        )
        engines: list[tuple[Engine, list[int]]] = [(bullet, [n for n, _, _ in bodies])]
        if riders:
            engines.append((MotionEngine([self.vehicles[n] for n in riders]), riders))
        return engines

    def _check_instants(self) -> None:
        """Refuse publications between two steps of Bullet, naming both numbers."""
        step, end_ns = Ticks.rate(self.rate_hz), self._run.duration_ns
        needed = [("duration_s", f"the duration {end_ns / 1e9:.9g} s", step.hits(end_ns))]
        for each in self._run.instants:
            period_ok = each.ticks.is_multiple_of(step)
            needed.append((each.key, f"the period {float(each.ticks.period) / 1e9:.9g} s", period_ok))
            needed.append((each.key, f"the offset {each.offset_ns / 1e9:.9g} s", step.hits(each.offset_ns)))
        for number, _, ticks, _ in self._sensors:
            key = f"vehicle.{self._names[number]}.positioning.rate_hz"
            needed.append((key, f"the period {float(ticks.period) / 1e9:.9g} s", ticks.is_multiple_of(step)))
        for key, what, fits in needed:
            if not fits:
                problem = f"{what} is not a whole number of physics steps (1/{self.rate_hz:g} s); "
                raise ScenarioError(problem + "use a multiple, or set physics.rate_hz", key=key or "physics.rate_hz")

    def _check_overlaps(self, bodies: Sequence[tuple[int, DifferentialDrive, tuple[float, float, float]]]) -> None:
        """Refuse bodies that start inside each other or inside a box: Bullet would fling them apart."""
        placed = [(self._names[n], model.footprint(pose), model.height_m) for n, model, pose in bodies]
        for number, (name, footprint, height_m) in enumerate(placed):
            for other, other_footprint, _ in placed[:number]:
                if footprint.overlaps(other_footprint):
                    raise ScenarioError(f"{name} and {other} overlap at the start; move one", key=f"vehicle.{name}.pose")
            for box in self.world.boxes:
                if box.blocks(footprint, height_m):
                    raise ScenarioError(
                        f"{name} overlaps the box at {box.center}, size {box.size}, at the start; move one",
                        key=f"vehicle.{name}.pose",
                    )
