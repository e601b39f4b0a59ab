"""Many worlds of one scenario side by side: bodies and channels as arrays, one Python step for all.

Each world gives what a run of the same scenario with its seed gives alone, to the last bit: the engines and layers are those of
a run, with more rows. So only what does not couple rows across worlds can be computed this way: vehicles without bodies
(``physics.kind`` is ``kinematic`` or ``flight``), wind without gusts, and radios without contention.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.assembly.vehicles import Fleet
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.federate import Instants, Needed, RunInfo
from vcmvsp.cosim.scenario.schema import Scenario

if TYPE_CHECKING:
    from vcmvsp.netsim.channel.side_by_side import Broadcasts
    from vcmvsp.physics.dynamics.free_flight import FreeFlightEngine
    from vcmvsp.physics.dynamics.kinematic import AerialEngine, GroundEngine

    RowsEngine = AerialEngine | FreeFlightEngine | GroundEngine

Floats = NDArray[np.float64]
CALM = np.zeros(3)  # m/s
_NO_KEYS = ("world", "vehicles", "outside", "firmware")  # of the parameters of physics


class WorldBatch:
    """The vehicles and channels of many worlds.

    Args:
        scenario, source: of all worlds.
        period_s: time between two ticks of all agents.

    Attributes:
        names: of the vehicles of a world.

    Raises:
        ScenarioError: the scenario has something that couples worlds, or that needs a run of its own.
    """

    def __init__(self, scenario: Scenario, source: Source, period_s: float) -> None:
        self._resolution = Resolution(scenario, source)
        self.names = tuple(each.name for each in scenario.vehicle)
        fleet = Fleet(scenario, source, self._resolution)
        self._models = [fleet.models[name] for name in self.names]
        from vcmvsp.physics.federate import FlightPhysics

        self._physics = {**binding.complete(FlightPhysics, {}, without=_NO_KEYS), **scenario.physics}
        for key, problem in _unbatchable(scenario, fleet):
            raise source.error(f"{problem}: only one world at a time can have it (vcmvsp.env.parallel_env)", key)
        self._channel, _, _ = radio.channel_of(scenario, source, solids=())
        trains = Ticks.every(period_s), Ticks.every(scenario.record.period_s)
        self._info = RunInfo(
            scenario=scenario.name,
            seed=scenario.seed,
            duration_ns=round(scenario.duration_s * 1e9),
            vehicles=self.names,
            instants=tuple(Instants(each) for each in trains),
        )

    def start(self, seeds: Sequence[int], poses: Floats) -> None:
        """Start worlds with these seeds, at poses (w, n, 4): x, y, z m and heading rad."""
        from vcmvsp.netsim.channel.side_by_side import SideBySide

        self._needed, self.now_ns = Needed(self._info), 0
        self._shape = poses.shape[:2]
        self._radio = SideBySide(self._channel, self.names, seeds)
        self._engines: list[tuple[RowsEngine, NDArray[np.intp]]] = []
        for make, rows in self._kinds():
            models = [self._models[row] for row in rows] * len(poses)
            flat = poses[:, rows].reshape(-1, 4)
            engine = make(models, flat[:, :3].tolist(), flat[:, 3].tolist())
            engine.expect(self._info.duration_ns, now=False)
            self._engines.append((engine, rows))

    def _kinds(self) -> "list[tuple[Callable[..., RowsEngine], NDArray[np.intp]]]":
        """Makers of the engines from models, positions and headings, each with the rows of its vehicles."""
        from vcmvsp.physics.dynamics.free_flight import FreeFlightEngine
        from vcmvsp.physics.dynamics.kinematic import AerialEngine, GroundEngine
        from vcmvsp.physics.vehicles.models import Quadrotor
        from vcmvsp.physics.vehicles.specification import flies

        in_air = np.array([flies(model) for model in self._models])
        has_rotors = np.array([isinstance(model, Quadrotor) for model in self._models]) & (self._physics["kind"] == "flight")
        rates = {name: self._physics[name] for name in ("rate_hz", "gravity")}
        makers: list[tuple[Any, NDArray[np.intp]]] = [
            (partial(GroundEngine, sensed=False), np.flatnonzero(~in_air)),
            (AerialEngine, np.flatnonzero(in_air & ~has_rotors)),
            (partial(FreeFlightEngine, wind=lambda _: CALM, **rates), np.flatnonzero(has_rotors)),
        ]
        return [(make, rows) for make, rows in makers if rows.size]

    def send(self, sends: NDArray[np.bool_], size_bytes: int) -> "Broadcasts":
        """Broadcast a message of each of these vehicles, (w, n), now."""
        return self._radio.send(self.now_ns, sends, self.motion()[0], size_bytes)

    def advance(self, commands: Floats, to_ns: int) -> None:
        """Follow commands (w, n, 4) up to a time: velocities as of `cosim.types.Velocity`, m/s, and yaw rates, rad/s."""
        for engine, rows in self._engines:
            own = commands[:, rows].reshape(-1, 4)
            engine.command_all(own[:, :3], own[:, 3])
        while self.now_ns < to_ns:  # as a run does, which publishes states in between
            after_ns = self._needed.after(self.now_ns)
            self.now_ns = to_ns if after_ns is None else min(after_ns, to_ns)
            for engine, _ in self._engines:
                engine.advance(self.now_ns)

    def motion(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Position (w, n, 3) m, velocity (w, n, 3) m/s, attitude (w, n, 4), and yaw rate (w, n) rad/s of all vehicles."""
        whole = tuple(np.zeros((*self._shape, width)) for width in (3, 3, 4, 3))
        for engine, rows in self._engines:
            motion = engine.read()
            sources = motion.position, motion.velocity, motion.attitude, motion.angular_velocity
            for target, source in zip(whole, sources, strict=True):
                target[:, rows] = source.reshape(len(target), len(rows), -1)
        position, velocity, attitude, spin = whole
        return position, velocity, attitude, spin[..., 2]


def _unbatchable(scenario: Scenario, fleet: Fleet) -> Iterator[tuple[str, str]]:
    """Keys and descriptions of what needs a run of its own."""
    from vcmvsp.physics.vehicles.models import GroundVehicle, Point, Quadrotor

    if scenario.physics.get("kind") not in ("kinematic", "flight"):
        yield "physics.kind", 'vehicles have bodies unless physics.kind is "kinematic" or "flight"'
    if scenario.world.get("kind", "empty") != "empty" or "wind" in scenario.world:
        yield "world", "a world with obstacles or wind"
    programs = scenario.bridge.doors, scenario.sockets.vehicles, scenario.stack
    if any((scenario.routing, scenario.radios, scenario.intervention, *programs)):
        yield "routing", "routing, several radios, interventions and external programs"
    if scenario.agents.latency_s:
        yield "agents.latency_s", "a latency of commands"
    for each in scenario.vehicle:
        key = f"vehicle.{each.name}"
        if each.pose_source != "truth":
            yield f"{key}.pose_source", "an estimated pose"
        if each.is_real or each.sensors or each.clock or each.battery or each.firmware:
            yield f"{key}.sensors", "sensors, clocks, batteries, firmware and real vehicles"
        if each.agent is not None:
            yield f"{key}.agent", "an agent of the scenario"
        model = fleet.models[each.name]
        if not isinstance(model, GroundVehicle | Point | Quadrotor) or getattr(model, "downwash", False):
            yield f"{key}.kind", "a vehicle of this kind"
