"""Commands on their way to the engines: impossible commands are refused, halted vehicles stand still."""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import NamedTuple

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.types import Velocity, Waypoint
from vcmvsp.physics.engine.interface import Engine

Command = Velocity | Waypoint
_STILL = Velocity()  # ground: the wheels stand; air: it hovers


class Mover(NamedTuple):
    """Engine of one vehicle, its row there, and whether it flies."""

    engine: Engine
    row: int
    flies: bool

    def obey(self, command: Command) -> None:
        """Follow a command from now on."""
        if isinstance(command, Velocity):
            self.engine.command(self.row, command.linear, command.yaw_rate)
        else:
            self.engine.go_to(self.row, command.position, command.yaw, command.speed)


class Commands:
    """Hands each vehicle's newest command to its engine.

    Args:
        movers: of each simulated vehicle.
        advance: advances all engines to a time, ns.
    """

    def __init__(self, movers: Mapping[str, Mover], advance: Callable[[int], None]) -> None:
        self._advance = advance
        self._movers = {f"{vehicle}/command": mover for vehicle, mover in movers.items()}
        self._newest: dict[str, Command] = {}
        self._halted: set[str] = set()
        self._advanced_ns = 0  # lower bound

    def take(self, key: str, time_ns: int, command: Command) -> None:
        """Apply a command from ``time_ns`` on; commands of other vehicles are ignored.

        Args:
            key: ``<vehicle>/command``.
            time_ns: ns.
            command: in the frame of its kind; of `Velocity`, ground vehicles use forward speed and yaw rate.

        Raises:
            FederateError: it is not finite, or a `Waypoint` for a ground vehicle or with a speed that is not positive.
        """
        mover = self._movers.get(key)
        if mover is None:
            return
        _check(key, command, mover.flies)
        self._newest[key] = command
        if key in self._halted:
            return
        if time_ns > self._advanced_ns:  # most commands come together
            self._advance(time_ns)
            self._advanced_ns = time_ns
        mover.obey(command)

    def halt(self, vehicles: Sequence[str], time_ns: int, *, halted: bool) -> None:
        """Halt vehicles from a time on, ns, or let them follow their newest commands again."""
        self._advance(time_ns)
        for key in (f"{vehicle}/command" for vehicle in vehicles):
            if key not in self._movers or (key in self._halted) == halted:
                continue
            (self._halted.add if halted else self._halted.discard)(key)
            self._movers[key].obey(_STILL if halted else self._newest.get(key, _STILL))


def _check(key: str, command: Command, flying: bool) -> None:
    if isinstance(command, Velocity):
        x, y, z = command.linear
        if isfinite(x + command.yaw_rate) and (not flying or isfinite(y + z)):
            return  # a sum is finite only if all are
        numbers = [*command.linear, command.yaw_rate] if flying else [x, command.yaw_rate]
    else:
        numbers = [*command.position, command.yaw or 0.0, command.speed or 0.0]
    vehicle, problem = key.partition("/")[0], ""
    if isinstance(command, Waypoint) and not flying:
        problem = f"{vehicle} was given a Waypoint but cannot fly: send Velocity, or make it a quadrotor or a point"
    elif not all(map(isfinite, numbers)):
        problem = f"the command of {vehicle} is not finite: {command}"
    elif isinstance(command, Waypoint) and command.speed is not None and command.speed <= 0.0:
        problem = f"the speed of the Waypoint of {vehicle} must be positive, not {command.speed} m/s"
    if problem:
        raise FederateError("physics", problem)
