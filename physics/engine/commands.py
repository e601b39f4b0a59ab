"""Commands on their way to the engines: what cannot be followed is refused, and who is halted stands still meanwhile."""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.types import Velocity, Waypoint
from vcmvsp.physics.engine.interface import Engine

Command = Velocity | Waypoint
_STILL = Velocity()  # ground: the wheels stand; air: it hovers


class Commands:
    """Hands each vehicle's newest command to its engine.

    Args:
        mover: of each vehicle that physics moves: its engine, its row there, and whether it flies.
        advance: moves all on to a time, ns.
    """

    def __init__(self, mover: Mapping[str, tuple[Engine, int, bool]], advance: Callable[[int], None]) -> None:
        self._advance = advance
        self._mover = {f"{vehicle}/command": own for vehicle, own in mover.items()}
        self._newest: dict[str, Command] = {}
        self._halted: set[str] = set()
        self._advanced_ns = 0  # so far at least

    def take(self, key: str, time_ns: int, command: Command) -> None:
        """Obey a command from its time on, ground vehicles its forward speed and yaw rate; of others it is none of ours.

        Args:
            key: ``<vehicle>/command``.
            time_ns: from when on.
            command: in the frame that its kind says.

        Raises:
            FederateError: it is not finite, or a `Waypoint` for a vehicle on the ground or of a speed that is not positive.
        """
        mover = self._mover.get(key)
        if mover is None:
            return
        engine, row, flying = mover
        _check(key, command, flying)
        self._newest[key] = command
        if key in self._halted:
            return
        if time_ns > self._advanced_ns:  # most commands come together
            self._advance(time_ns)
            self._advanced_ns = time_ns
        _obey(engine, row, command)

    def halt(self, vehicles: Sequence[str], time_ns: int, *, halted: bool) -> None:
        """Have vehicles stand still from a time on, ns, or follow their newest commands again."""
        self._advance(time_ns)
        for key in (f"{vehicle}/command" for vehicle in vehicles):
            if key not in self._mover or (key in self._halted) == halted:
                continue
            (self._halted.add if halted else self._halted.discard)(key)
            engine, row, _ = self._mover[key]
            _obey(engine, row, _STILL if halted else self._newest.get(key, _STILL))


def _obey(engine: Engine, row: int, command: Command) -> None:
    if isinstance(command, Velocity):
        engine.command(row, command.linear, command.yaw_rate)
    else:
        engine.go_to(row, command.position, command.yaw, command.speed)


def _check(key: str, command: Command, flying: bool) -> None:
    """Refuse what a vehicle cannot follow."""
    if isinstance(command, Velocity):
        x, y, z = command.linear
        if isfinite(x + command.yaw_rate) and (not flying or isfinite(y + z)):
            return  # a sum is finite only if all are
    vehicle, problem = key.partition("/")[0], ""
    if isinstance(command, Waypoint) and not flying:
        problem = f"{vehicle} was given a Waypoint but cannot fly: send Velocity, or make it a quadrotor or a point"
    elif not all(map(isfinite, _numbers(command, flying))):
        problem = f"the command of {vehicle} is not finite: {command}"
    elif isinstance(command, Waypoint) and command.speed is not None and command.speed <= 0.0:
        problem = f"the speed of the Waypoint of {vehicle} must be positive, not {command.speed} m/s"
    if problem:
        raise FederateError("physics", problem)


def _numbers(command: Command, flying: bool) -> list[float]:
    """The numbers of a command that count."""
    if isinstance(command, Velocity):
        return [*(command.linear if flying else command.linear[:1]), command.yaw_rate]
    return [*command.position, *(each for each in (command.yaw, command.speed) if each is not None)]
