"""The Bullet engine: ground robots, quadrotors, external vehicles and movables in one Bullet world, and their contacts."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.dynamics.bullet.bodies import ExternalBodies, WorldBodies
from vcmvsp.physics.dynamics.bullet.ground_robots import GroundRobots
from vcmvsp.physics.dynamics.bullet.quadrotors import REACH_M, BulletQuadrotors
from vcmvsp.physics.dynamics.engine import BodyMotion, FleetEngine, Touch, gathered
from vcmvsp.physics.dynamics.kinematic import ExternalEngine
from vcmvsp.physics.dynamics.odometry import ENCODER_HZ
from vcmvsp.physics.vehicles.specification import VehicleSpec, roles_of
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World


class BulletEngine(FleetEngine):
    """Moves differential drives and quadrotors in one Bullet world without a window.

    Args:
        world: floor, solids, and what else is in it.
        vehicles: without overlap at the start; each name has its own gusts.
        seed: of the gusts.
        rate_hz: Bullet steps a second.
        iterations: of the constraint solver in each step.
        gravity: m/s2, downwards.
        accelerations: whether to compute accelerations of ground robots; else they are zero.
        external: the external vehicles among ``vehicles``, of any model.
    """

    def __init__(
        self,
        *,
        world: World,
        vehicles: Sequence[VehicleSpec],
        seed: int = 0,
        rate_hz: float,
        iterations: int,
        gravity: float,
        accelerations: bool = False,
        external: ExternalEngine | None = None,
    ) -> None:
        super().__init__(rate_hz)
        self._encoder_steps = max(1, round(rate_hz / ENCODER_HZ))
        self._count, self._accelerations, self._external = len(vehicles), accelerations, external
        ground, air, outside = roles_of(vehicles, external.names if external else ())
        self._ground_rows, self._air_rows, self._external_rows = [*ground], [*air], [*outside]
        self._robot_of = {row: k for k, row in enumerate(self._ground_rows)}
        self._flyer_of = {row: k for k, row in enumerate(self._air_rows)}
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise RuntimeError("Bullet returned no physics client: too many are open in this process; close other simulations")
        solver = {"fixedTimeStep": self._step_s, "numSolverIterations": iterations, "deterministicOverlappingPairs": 1}
        p.setPhysicsEngineParameter(**solver, physicsClientId=self._client)
        p.setGravity(0.0, 0.0, -gravity, physicsClientId=self._client)
        try:
            self._things = WorldBodies(self._client, world)
            self._robots = GroundRobots(self._client, world, [*ground.values()], self._step_s)
            step: dict[str, Any] = {"gravity": gravity, "step_s": self._step_s}
            self._flyers = BulletQuadrotors(self._client, world, [*air.values()], seed=seed, **step)
            self._external_bodies: ExternalBodies | None = None
            if external:
                hulls = [spec.model.hull for spec in outside.values()]
                self._external_bodies = ExternalBodies(self._client, external, hulls, **step)
        except BaseException:
            self.close()
            raise
        self.fleet = self._flyers.fleet
        others = [*self._things.movables, *self._things.moving]
        placed = self._things if others else None, self._external_bodies
        self._placed = [each for each in placed if each]  # before each step
        jointed = [row for row, spec in ground.items() if isinstance(spec.model, UrdfDrive)]
        self._contacts = ContactFinder(self._client, self._bodies(), others, jointed)
        self._passing: list[Touch] = []  # of quadrotors, since the last call of `touching` with ``passing``
        drives: list[Any] = [spec.model for spec in ground.values()]
        # How far from its centre of mass each robot may touch something before the next look, m.
        models_m = [(float(np.linalg.norm(each.hull.size)), each.max_speed * self._flyers.look_s) for each in drives]
        self._robot_reach = np.array(models_m).reshape(-1, 2).sum(axis=1)
        self._robot_top = max((model.hull.size[2] for model in drives), default=0.0)

    def _bodies(self) -> dict[int, int]:
        """Bodies by rows."""
        bodies = dict(zip(self._ground_rows, self._robots.bodies, strict=True))
        bodies |= zip(self._air_rows, self._flyers.bodies, strict=True)
        if self._external_bodies:
            bodies |= zip(self._external_rows, self._external_bodies.bodies, strict=True)
        return bodies

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, and a yaw rate, rad/s, which firmware or autopilot approach."""
        if row in self._robot_of:
            self._robots.firmware.command(self._robot_of[row], linear[0], yaw_rate)
        else:
            self.fleet.set_velocity(self._flyer_of[row], linear, yaw_rate)

    def advance(self, to_ns: int) -> None:
        """Advance to the Bullet step nearest to ``to_ns``."""
        flyers, drive = self._flyers, bool(self._ground_rows)
        times_ns, ahead = [self._ticks.at(number) for number in range(self._step, self._step_at(to_ns))], 0
        for done, now_ns in enumerate(times_ns):
            if drive:
                self._drive(last=done + 1 == len(times_ns))
            for bodies in self._placed:
                bodies.place(now_ns)
            if not ahead:
                ahead = self._fly(times_ns[done:])
            ahead -= 1
            if drive or self._placed or flyers.near_rows:  # else Bullet has nothing to move
                p.stepSimulation(self._client)
            self._step += 1
            flyers.take()
            if flyers.hits:
                self._passing += self._contacts.now([self._air_rows[k] for k in flyers.hits])
            if drive and self._step % self._encoder_steps == 0:
                self._robots.encode()
        if self._external:
            self._external.advance(to_ns)

    def _drive(self, *, last: bool) -> None:
        """Run the firmware of ground robots before a step, the last of this advance or not."""
        self._robots.cycle()
        if self._accelerations and last:
            self._robots.save_velocities()

    def _fly(self, times_ns: Sequence[int]) -> int:
        """Move quadrotors in the first steps at these times; returns their number."""
        if not self._air_rows:
            return len(times_ns)
        if self._flyers.look_is_due:
            self._look(times_ns[0])
        return self._flyers.push(times_ns)

    def _look(self, now_ns: int) -> None:
        places, reach = self._things.spheres(now_ns, self._flyers.look_s)
        if self._ground_rows and float(self.fleet.position[:, 2].min()) < self._robot_top + REACH_M:
            at = [p.getBasePositionAndOrientation(body, self._client)[0] for body in self._robots.bodies]
            places, reach = np.concatenate([places, at]), np.concatenate([reach, self._robot_reach])
        if self._external_bodies:
            external, around = self._external_bodies.spheres(now_ns, self._flyers.look_s)
            places, reach = np.concatenate([places, external]), np.concatenate([reach, around])
        self._flyers.look(places, reach)

    def read(self) -> BodyMotion:
        """Motion of every vehicle."""
        rows = (self._ground_rows, self._air_rows, self._external_rows)
        parts = zip((self._robots, self._flyers, self._external), rows, strict=True)
        return gathered([(each.read(), np.array(own)) for each, own in parts if each and own], self._count)

    def movables(self) -> BodyMotion:
        """Motion of every movable."""
        return self._things.read()

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable at a place; quadrotors look for it before the next step."""
        self._things.put(number, place, yaw)
        self._flyers.look_is_due = True

    def touching(self, *, passing: bool) -> list[Touch]:
        """Contacts in this step; with ``passing`` also bounces of quadrotors since the last such call."""
        near = [self._air_rows[k] for k in np.flatnonzero(self._flyers.near).tolist()]
        touches = self._contacts.now([*self._ground_rows, *near, *self._external_rows])
        if passing:
            touches, self._passing = sorted(touches + self._passing, key=lambda each: each.key), []
        return touches

    def close(self) -> None:
        """Release the Bullet world."""
        if self._client >= 0:
            p.disconnect(self._client)
            self._client = -1


_ANY_BODY, _ANY_LINK, _BASE = -1, -2, -1
_FLOOR = 0  # the first body of all


class ContactFinder:
    """Finds contacts of vehicles: ``bodies`` of the vehicles by row, ``others`` in the rows after them.

    Bodies in ``jointed`` count with all links, others with the base alone.
    """

    def __init__(self, client: int, bodies: Mapping[int, int], others: Sequence[int], jointed: Collection[int]) -> None:
        self._client, self._bodies = client, bodies
        # Where only the base can touch more than the floor, contacts of wheels need not be listed.
        self._links = dict.fromkeys(bodies, _BASE) | dict.fromkeys(jointed, _ANY_LINK)
        self._row_of = {body: row for row, body in (*bodies.items(), *enumerate(others, len(bodies)))}

    def now(self, rows: Sequence[int]) -> list[Touch]:
        """Contacts of these rows with a force in this step, by rows: one for each place."""
        touches = []
        for row in rows:
            for contact in p.getContactPoints(self._bodies[row], _ANY_BODY, self._links[row], _ANY_LINK, self._client):
                body, place, force = contact[2], contact[5], contact[9]
                if force > 0.0 and body != _FLOOR:
                    other = self._row_of.get(body)
                    if other is None or other > row:
                        touches.append(Touch(row, other, place))
                    elif other not in rows:  # else the row of the other body adds it
                        touches.append(Touch(other, row, place))
        return sorted(touches, key=lambda each: each.key)
