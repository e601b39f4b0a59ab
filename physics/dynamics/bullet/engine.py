"""The Bullet world: robots that drive, quadrotors that fly, things that can be pushed, and what touches what."""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.dynamics.bullet.airborne_clearance import REACH_M
from vcmvsp.physics.dynamics.bullet.contacts import Touches
from vcmvsp.physics.dynamics.bullet.external_vehicles import Shown
from vcmvsp.physics.dynamics.bullet.ground_robots import Robots
from vcmvsp.physics.dynamics.bullet.quadrotors import Flyers
from vcmvsp.physics.dynamics.bullet.world_bodies import Things
from vcmvsp.physics.dynamics.external_vehicles import Reflected
from vcmvsp.physics.dynamics.wind import Gusts
from vcmvsp.physics.engine.interface import Motion, Touch, gathered
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.quadrotor import Quadrotor
from vcmvsp.physics.vehicles.specification import Vehicle
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import World

_ENCODER_HZ = 40.0


class BulletEngine:
    """Moves differential drives and quadrotors in one Bullet world without a window.

    Args:
        world: floor, solids, and what else is in it.
        models: what the vehicles are.
        positions: where their reference points start, m. They must not overlap.
        headings: rad.
        names: of the vehicles: each has gusts of its own.
        seed: of the gusts.
        rate_hz: Bullet steps a second; ``advance`` goes to the step nearest to the time asked for.
        iterations: of the constraint solver in each step.
        gravity: m/s2, downwards.
        accelerations: whether anybody wants those of robots; they are zero otherwise.
        reflected: those of the vehicles that something else moves, whatever their model.
    """

    stepped = True

    def __init__(
        self,
        *,
        world: World,
        models: Sequence[Vehicle],
        positions: Sequence[Vec3],
        headings: Sequence[float],
        names: Sequence[str] | None = None,
        seed: int = 0,
        rate_hz: float,
        iterations: int,
        gravity: float,
        accelerations: bool = False,
        reflected: Reflected | None = None,
    ) -> None:
        self._ticks, self._step, self._step_s = Ticks.rate(rate_hz), 0, 1.0 / rate_hz
        self._encoder_steps = max(1, round(rate_hz / _ENCODER_HZ))
        self._world, self._count = world, len(models)
        names = names or [str(row) for row in range(len(models))]
        self._showing = [names.index(each) for each in reflected.names] if reflected else []
        moved = {row: model for row, model in enumerate(models) if row not in self._showing}
        drives = {row: model for row, model in moved.items() if isinstance(model, DifferentialDrive | UrdfDrive)}
        quadrotors = {row: model for row, model in moved.items() if isinstance(model, Quadrotor)}
        self._driving, self._flying = list(drives), list(quadrotors)
        self._robot_of = {row: k for k, row in enumerate(self._driving)}
        self._flyer_of = {row: k for k, row in enumerate(self._flying)}
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise RuntimeError("Bullet gave no physics client: too many are open in this process")
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._step_s,
            numSolverIterations=iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )
        p.setGravity(0.0, 0.0, -gravity, physicsClientId=self._client)

        def start(rows: list[int]) -> tuple[list[Vec3], list[float]]:
            return [positions[row] for row in rows], [headings[row] for row in rows]

        try:
            self._things = Things(self._client, world)
            self._robots = Robots(self._client, world, [*drives.values()], *start(self._driving), self._step_s)
            self._flyers = Flyers(
                self._client,
                [*quadrotors.values()],
                *start(self._flying),
                gravity=gravity,
                step_s=self._step_s,
                gusts=Gusts(world.wind, [names[row] for row in self._flying], seed),
                shapes=world.shapes,
            )
            hulls = [models[row].hull for row in self._showing]
            self._shown = Shown(self._client, reflected, hulls, gravity=gravity, step_s=self._step_s) if reflected else None
        except BaseException:
            self.close()
            raise
        bodies = {row: self._robots.bodies[k] for k, row in enumerate(self._driving)}
        bodies |= {row: self._flyers.bodies[k] for k, row in enumerate(self._flying)}
        if self._shown:
            bodies |= dict(zip(self._showing, self._shown.bodies, strict=True))
        others = [*self._things.movables, *self._things.moving]
        jointed = [row for row, model in drives.items() if isinstance(model, UrdfDrive)]
        self._touches = Touches(self._client, bodies, others, jointed)
        self._hits: list[Touch] = []  # of quadrotors since what touched in passing was last asked for
        self._accelerations = accelerations
        self._robot_reach = np.array([_reach_m(model, self._flyers.look_s) for model in drives.values()])
        self._robot_top = max((model.hull.size[2] for model in drives.values()), default=0.0)

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """From now on move like this, as soon as firmware or autopilot get there."""
        if row in self._robot_of:
            self._robots.command(self._robot_of[row], linear[0], yaw_rate)
        else:
            self._flyers.fleet.set_velocity(self._flyer_of[row], linear, yaw_rate)

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """From now on fly there."""
        self._flyers.fleet.set_waypoint(self._flyer_of[row], position, yaw, speed)

    def advance(self, to_ns: int) -> None:
        """Step on to the Bullet step nearest to ``to_ns``."""
        ticks = self._ticks
        until = (to_ns * ticks.per + ticks.ns // 2) // ticks.ns
        robots, flyers = self._robots, self._flyers
        step, client, drive, fly = p.stepSimulation, self._client, bool(self._driving), bool(self._flying)
        while self._step < until:
            if drive:
                robots.cycle()
                if self._accelerations and self._step + 1 == until:
                    robots.note()
            self._place()
            if fly:
                if flyers.look_is_due:
                    self._look()
                flyers.push(ticks.at(self._step))
            step(client)
            self._step += 1
            if fly:
                flyers.take()
                if flyers.hits:
                    self._hits += self._touches.now([self._flying[k] for k in flyers.hits])
            if drive and self._step % self._encoder_steps == 0:
                robots.encode()
        if self._shown:
            self._shown.advance(to_ns)

    def _place(self) -> None:
        """Put whatever moves by itself where it belongs before a step."""
        now_ns = self._ticks.at(self._step)
        self._things.place(now_ns)
        if self._shown:
            self._shown.place(now_ns)

    def _look(self) -> None:
        """Have the quadrotors look around for whatever else moves."""
        places, reach = self._things.spheres(self._ticks.at(self._step), self._flyers.look_s)
        if self._driving and float(self._flyers.fleet.position[:, 2].min()) < self._robot_top + REACH_M:
            at = [p.getBasePositionAndOrientation(body, self._client)[0] for body in self._robots.bodies]
            places, reach = np.concatenate([places, at]), np.concatenate([reach, self._robot_reach])
        if self._shown:
            shown, around = self._shown.spheres(self._ticks.at(self._step), self._flyers.look_s)
            places, reach = np.concatenate([places, shown]), np.concatenate([reach, around])
        self._flyers.look(places, reach)

    def read(self) -> Motion:
        """How every vehicle moves now."""
        parts = []
        if self._driving:
            parts.append((self._robots.read(), np.array(self._driving)))
        if self._flying:
            parts.append((self._flyers.read(), np.array(self._flying)))
        if self._shown:
            parts.append((self._shown.read(), np.array(self._showing)))
        return gathered(parts, self._count)

    def movables(self) -> Motion:
        """How every movable moves now."""
        return self._things.read()

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable somewhere, and have quadrotors look for it before the next step."""
        self._things.put(number, place, yaw)
        self._flyers.look_is_due = True

    def touching(self, *, passing: bool) -> list[Touch]:
        """What presses against each other in this step; with ``passing`` also what quadrotors have bounced off since then."""
        near = [self._flying[k] for k in np.flatnonzero(self._flyers.near).tolist()]
        found = self._touches.now([*self._driving, *near, *self._showing])
        if passing:
            found, self._hits = sorted(found + self._hits, key=lambda each: each.key), []
        return found

    def close(self) -> None:
        """Give the Bullet world back."""
        if self._client >= 0:
            p.disconnect(self._client)
            self._client = -1


def _reach_m(model: DifferentialDrive | UrdfDrive, span_s: float) -> float:
    """How far from its centre of mass a robot may touch something within ``span_s``."""
    return float(np.linalg.norm(model.hull.size)) + model.max_speed * span_s
