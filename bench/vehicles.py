"""Vehicles without sensors beside bare ``stepSimulation`` of the same world: the cost of everything around it.

Run with ``python -m bench.vehicles``. CPU time of one core, in turn with the peer.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from bench.measure import Row, cpu, in_turn, measured, table
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, Instants, RunInfo
from vcmvsp.cosim.types import Later, Velocity
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, p
from vcmvsp.physics.federate import BulletPhysics, MujocoPhysics, Physics
from vcmvsp.physics.vehicles.models import P2DX, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World

ROUNDS = 5
STEADY_NS = 2 * SECOND_NS  # they start up until then, untimed
TENTH_NS = SECOND_NS // 10


class Fleet(NamedTuple):
    """Vehicles of a row of the table."""

    robots: int
    quadrotors: int
    rate_hz: float = 120.0
    iterations: int = 20
    duration_s: float = 4.0
    kind: type[Physics] = BulletPhysics

    def specs(self) -> list[VehicleSpec]:
        """Robots on circles of their own, quadrotors 5 m above."""
        cars = [
            VehicleSpec(name=f"car{n}", model=P2DX(), position=(3.0 * (n % 10), 3.0 * (n // 10), 0.0))
            for n in range(self.robots)
        ]
        drones = [
            VehicleSpec(name=f"uav{n}", model=Quadrotor(), position=(3.0 * (n % 10), 3.0 * (n // 10), 5.0))
            for n in range(self.quadrotors)
        ]
        return cars + drones

    def commands(self, now_ns: int) -> list[Event]:
        """New commands for all, as from ten agents a second: robots drive on, quadrotors weave."""
        turn = 1.0 if now_ns // SECOND_NS % 2 else -1.0
        cars = [Event(f"car{n}/command", now_ns, Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.3)) for n in range(self.robots)]
        weave = Velocity(linear=(turn, 0.5 * turn, 0.0), yaw_rate=0.2)
        return cars + [Event(f"uav{n}/command", now_ns, weave) for n in range(self.quadrotors)]


def federate_cpu_s(
    fleet: Fleet, vehicles: Sequence[VehicleSpec] = (), world: World | None = None, requested_keys: tuple[str, ...] = ()
) -> float:
    """CPU seconds per simulated second of the federate: commands and publications ten times a second.

    Args:
        fleet: numbers of vehicles.
        vehicles: their starts and equipment; default: without equipment.
        world: default: only a floor.
        requested_keys: keys of readings that are read as soon as they are published.
    """
    physics = _started(fleet, vehicles or fleet.specs(), world or World(), requested_keys)
    times_ns = [STEADY_NS + k * TENTH_NS for k in range(1, int(10 * fleet.duration_s) + 1)]
    commands = [fleet.commands(now_ns - TENTH_NS) for now_ns in times_ns]  # untimed: agents give them
    looked_at = frozenset(requested_keys)

    def work() -> None:
        for now_ns, inbox in zip(times_ns, commands, strict=True):
            step = physics.step(now_ns, inbox)
            if looked_at:
                for event in step.events:
                    if isinstance(event.value, Later) and event.key in looked_at:
                        event.value.get()

    seconds = cpu(work)
    physics.close()
    return seconds / fleet.duration_s


def bare_cpu_s(fleet: Fleet) -> float:
    """CPU seconds per simulated second of Bullet's own steps with the same robots, every quadrotor a body."""
    robots = Fleet(fleet.robots, 0, fleet.rate_hz, fleet.iterations)
    physics = _started(robots, robots.specs(), World(), ())
    client: int = physics._engines[0][0]._client  # type: ignore[attr-defined]
    for n in range(fleet.quadrotors):
        _quadrotor(client, (3.0 * (n % 10), 3.0 * (n // 10), 1000.0))
    steps = range(int(fleet.duration_s * fleet.rate_hz))

    def work() -> None:
        for _ in steps:
            p.stepSimulation(client)

    seconds = cpu(work)
    physics.close()
    return seconds / fleet.duration_s


def _quadrotor(client: int, position: tuple[float, float, float]) -> None:
    model = Quadrotor()
    shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=model.radius_m, height=model.height_m, physicsClientId=client)
    body = p.createMultiBody(model.mass_kg, shape, basePosition=position, physicsClientId=client)
    p.changeDynamics(
        body, -1, localInertiaDiagonal=model.inertia, linearDamping=0.0, angularDamping=0.0, physicsClientId=client
    )
    p.setCollisionFilterGroupMask(body, -1, SOLID, FLOOR | SOLID, client)


def _started(fleet: Fleet, vehicles: Sequence[VehicleSpec], world: World, requested_keys: tuple[str, ...]) -> Physics:
    physics = fleet.kind(world=world, vehicles=vehicles, rate_hz=fleet.rate_hz, iterations=fleet.iterations)
    run = RunInfo(
        scenario="bench",
        seed=0,
        duration_ns=1000 * SECOND_NS,
        vehicles=tuple(spec.name for spec in vehicles),
        instants=(Instants(Ticks.every(0.1)),),
        wanted=requested_keys,
    )
    physics.start(run)
    physics.step(STEADY_NS, fleet.commands(0))
    return physics


def _beside_bare(name: str, fleet: Fleet, most: float) -> Row:
    ours, other, ratio = in_turn(lambda: federate_cpu_s(fleet), lambda: bare_cpu_s(fleet), ROUNDS)
    words = f"{name}, {fleet.rate_hz:g} Hz, {fleet.iterations} iterations; beside stepSimulation alone"
    return Row(words, f"{1.0 / ours:.1f}x real time", f"{1.0 / other:.1f}x", ratio, f"<= {most:g}", ratio <= most)


def robots_10() -> Row:
    """Ten Pioneers."""
    return _beside_bare("10 p2dx", Fleet(10, 0), 1.25)


def robots_50() -> Row:
    """Fifty Pioneers."""
    return _beside_bare("50 p2dx", Fleet(50, 0, duration_s=2.0), 1.25)


def robots_mujoco() -> Row:
    """Fifty Pioneers in MuJoCo beside the same in Bullet."""
    here, there = (Fleet(50, 0, duration_s=2.0, kind=kind) for kind in (MujocoPhysics, BulletPhysics))
    ours, other, ratio = in_turn(lambda: federate_cpu_s(here), lambda: federate_cpu_s(there), ROUNDS)
    name = "50 p2dx in MuJoCo, 120 Hz; beside the same in Bullet, 20 iterations"
    return Row(name, f"{1.0 / ours:.1f}x real time", f"{1.0 / other:.1f}x", ratio, "<= 0.5", ratio <= 0.5)


def mixed_50() -> Row:
    """Fifty of each."""
    return _beside_bare("50 p2dx, 50 quadrotors", Fleet(50, 50, duration_s=2.0), 1.7)


def quadrotors_50() -> Row:
    """Fifty quadrotors."""
    return _beside_bare("50 quadrotors", Fleet(0, 50), 6.0)


def quadrotors_100() -> Row:
    """A hundred quadrotors."""
    return _beside_bare("100 quadrotors", Fleet(0, 100), 6.0)


def quadrotors_real_time() -> Row:
    """A hundred quadrotors at 240 Hz."""
    fleet = Fleet(0, 100, rate_hz=240.0)
    ours, other, ratio = in_turn(lambda: federate_cpu_s(fleet), lambda: bare_cpu_s(fleet), ROUNDS)
    speed = 1.0 / ours
    name = "100 quadrotors, 240 Hz, as speed; beside stepSimulation alone"
    return Row(name, f"{speed:.1f}x real time", f"{1.0 / other:.1f}x", ratio, "goal: >= 4x real time", speed >= 4.0)


ALL: Sequence[Callable[[], Row]] = (
    robots_10,
    robots_50,
    robots_mujoco,
    mixed_50,
    quadrotors_50,
    quadrotors_100,
    quadrotors_real_time,
)


def rows() -> list[Row]:
    """All rows."""
    return measured(ALL)


if __name__ == "__main__":
    print(table(rows()))
