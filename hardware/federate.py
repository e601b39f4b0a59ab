"""The federate `hardware`: real vehicles replace simulated ones, under the same names and keys.

Events of a real vehicle, at the instants at which physics publishes those of simulated ones:

========================  ============  ===================================================================================
``<vehicle>/estimate``    VehicleState  estimated state
``<vehicle>/odometry``    Odometry      wheel odometry, extrapolated to this instant
``<vehicle>/fix``         Fix           new positions
``<vehicle>/sonar``       Measured      new ranges, m, by the numbers of the sonars
``<vehicle>/real``        RealStatus    age and uncertainty, the command that was sent, and the causes that changed it
``<vehicle>/incident``    Incident      connected, lost, stopped: with its cause
========================  ============  ===================================================================================

Commands go to the robot at once, and so does ``operator/halted`` (`Halted`): a halted vehicle gets zero velocity in place of
its agent's commands, and all safety rules stay active; after the halt it follows the newest command.

Physics shows the vehicle at the state that `states` returns (`cosim.federate.ExternalMotion`).
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks, WallClock
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, Log, Needed, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.types import Array, Follows, Halted, Outage, States, VehicleState
from vcmvsp.hardware.real_vehicle import VehicleProxy
from vcmvsp.hardware.stations import Connections

HEARTBEAT = Ticks.every(0.05)
"""Period of orders; a station without orders stops its robot."""

KNOWN_S = 1.0  # extrapolation time of other vehicles
MOST = 500  # other vehicles in an order


class Hardware:
    """All real vehicles of a run.

    Args:
        vehicles: tables of the real vehicles.
        run: name of the run.
        clock: paces the run; its times are those of the robots.
        radius_m: of a circle around the body of each vehicle of the run, by name.
        tell: takes lines for the user.
        log: takes what a replay needs: key, time, value.
        connect: connect to the robots; False: vehicles stand at their starts while a scenario is checked.
    """

    name = "hardware"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    latest: tuple[str, ...] = ("world/states",)

    def __init__(
        self,
        vehicles: Sequence[RealVehicle],
        *,
        run: str,
        clock: WallClock,
        radius_m: Mapping[str, float],
        tell: Callable[[str], None],
        log: Log,
        connect: bool,
    ) -> None:
        self.names = tuple(each.name for each in vehicles)
        self.reads = self.wakes = (*(f"{name}/command" for name in self.names), "operator/halted")
        self._clock, self._radius_m, self._log = clock, radius_m, log
        self._proxies = {each.name: VehicleProxy(each, clock) for each in vehicles}
        self._run, self._tell, self._connect = run, tell, connect
        self._connections: Connections | None = None
        self._world: tuple[int, States] | None = None  # time and states
        self._published_ns = -1
        self._lost = set[str]()  # lost vehicles, while the run continues

    def start(self, run: RunInfo) -> int:
        """Connect to all robots; they stand until their first command.

        Raises:
            ScenarioError: the radius of a vehicle is unknown, so robots cannot keep away from it.
        """
        for name in run.vehicles:
            if self.names != (name,) and not 0.0 < (radius_m := self._radius_m.get(name, 0.0)) < np.inf:
                problem = f"{name} has a radius of {radius_m:g} m: real vehicles cannot keep away from it; give its kind a hull"
                raise ScenarioError(problem, key=f"vehicle.{name}.kind")
        self._needed, self._end_ns = Needed(run), run.duration_ns
        if self._connect:
            driven = [proxy.vehicle for proxy in self._proxies.values()]
            self._connections = Connections(driven, self._run, self._tell, run.periods_s)
            for name, station in self._connections.open().items():
                self._proxies[name].station = station
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Process commands and reports, publish, and send orders."""
        for event in inbox:
            self._take(event)
        events: list[Event] = []
        for proxy in self._proxies.values():
            if proxy.over is not None:
                raise proxy.over
            proxy.hear()
            if proxy.lost is not None and proxy.vehicle.name not in self._lost:
                events += self._go_on_without(proxy.vehicle, now_ns)
        if now_ns != self._published_ns and self._needed.hits(now_ns):
            self._published_ns = now_ns
            events += [event for proxy in self._proxies.values() for event in proxy.publish(now_ns)]
        elif any(proxy.over for proxy in self._proxies.values()):  # raised at the next step, after this is recorded
            events += [event for proxy in self._proxies.values() for event in proxy.last_words(now_ns)]
        for event in events:
            key = f"{event.value.vehicles[0]}/outage" if isinstance(event.value, Outage) else event.key
            self._log(key, event.time_ns, event.value)
        for name, proxy in self._proxies.items():
            proxy.order(self._others(name), now_ns=now_ns)
        return Step(events, self._next(now_ns))

    def states(self, now_ns: int) -> list[VehicleState]:
        """States of the vehicles, for physics."""
        states = [proxy.state(now_ns) for proxy in self._proxies.values()]
        for name, state in zip(self.names, states, strict=True):
            self._log(f"{name}/reflected", now_ns, state)
        return states

    def release(self) -> None:
        """Stop all robots at once."""
        for proxy in self._proxies.values():
            with contextlib.suppress(FederateError):  # a robot without a station has a watchdog
                proxy.order(None, stop="the run is over")

    def close(self) -> None:
        """Stop and disconnect all robots."""
        if self._connections is not None:
            self._connections.close()

    def _take(self, event: Event) -> None:
        if isinstance(event.value, States):
            self._world = event.time_ns, event.value
        elif isinstance(event.value, Halted):
            for name in event.value.vehicles:
                if name in self._proxies:  # other vehicles are simulated
                    self._proxies[name].halted = event.value.halted
        else:
            self._proxies[event.key.partition("/")[0]].command(event)

    def _go_on_without(self, vehicle: RealVehicle, now_ns: int) -> list[Event]:
        """Close the station of a lost robot; a removed vehicle loses radio and place."""
        self._lost.add(vehicle.name)
        if self._connections is not None:
            self._connections.drop(vehicle.name)
        if vehicle.on_lost == "hold":
            return []
        gone = Outage(vehicles=(vehicle.name,), until_ns=self._end_ns)
        return [
            Event("operator/outage", now_ns, gone),  # like an operator's outage
            Event(f"{vehicle.name}/follows", now_ns, Follows(leader=None)),
        ]

    def _next(self, now_ns: int) -> int | None:
        needed_ns = self._needed.after(now_ns)
        return needed_ns if needed_ns is None or not self._connect else min(needed_ns, HEARTBEAT.after(now_ns))

    def _others(self, name: str) -> Array | None:
        """Other vehicles nearest to this one, at the current wall time (n, 7): x y z m, vx vy vz m/s, radius m."""
        if self._world is None:
            return None
        world_ns, world = self._world
        age_s = min(max(0, self._clock.logical_ns(time.monotonic_ns()) - world_ns) / SECOND_NS, KNOWN_S)
        own = world.names.index(name)
        distance = np.linalg.norm(world.position - world.position[own], axis=1)
        rows = [row for row in np.argsort(distance, kind="stable")[: MOST + 1].tolist() if row != own]
        radii = [self._radius_m[world.names[row]] for row in rows]
        return np.column_stack([world.position[rows] + age_s * world.velocity[rows], world.velocity[rows], radii])
