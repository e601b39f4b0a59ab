"""Control of a run by programs of its stacks (`cosim.federate.RunControl`), with the means of the control station."""

import time
from collections.abc import Callable, Mapping, Sequence

from vcmvsp.cosim.assembly.run import AssembledRun
from vcmvsp.cosim.clock import LISTEN_NS, Clock, LiveClock, seconds_to_ns
from vcmvsp.cosim.federate import ControllingStack, Event
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.scenario.schema import MoveTable
from vcmvsp.cosim.types import Pushed, States, VehicleState


class StackControl:
    """Lets the stacks of a run see and change it.

    Args:
        stacks: those with programs that may control the run.
        stop: ends the run.
        clock: of the run; one that can pause replaces it, where nothing but these stacks takes part.
    """

    def __init__(
        self, run: AssembledRun, stacks: Sequence[ControllingStack], *, stop: Callable[[], None], clock: Clock
    ) -> None:
        self._operator, self._stacks, self.end = run.operator, stacks, stop
        self.may_pause = run.robots is None and run.bridge is None and len(stacks) == len(run.stacks)
        self.clock = LiveClock(clock.speed, self.listen) if self.may_pause else clock
        self.step_s = min(run.info.periods_s.values())
        self.obstacles = tuple(each.name for each in run.world.movables)
        self.also: Callable[[], None] = lambda: None  # called whenever the programs are, also during a pause
        self._first = {each.name: each.pose(0.0) for each in run.world.movables}
        self._states: Event | None = None
        self._pushed: Event | None = None
        self._listened_ns = 0

    def on(self, event: Event) -> None:
        """Note the newest states."""
        if type(event.value) is States:
            self._states = event
        elif type(event.value) is Pushed:
            self._pushed = event

    def on_instant(self, now_ns: int) -> None:
        """Attend to programs if `LISTEN_NS` have passed: only a `LiveClock` does it by itself."""
        if not self.may_pause and time.monotonic_ns() - self._listened_ns >= LISTEN_NS:
            self.listen()

    def listen(self) -> None:
        """Carry out the requests of programs."""
        self._listened_ns = time.monotonic_ns()
        for each in self._stacks:
            each.attend(self)
        self.also()

    @property
    def paused(self) -> bool:
        """Whether the run is paused, or makes steps."""
        return isinstance(self.clock, LiveClock) and self.clock.paused

    @property
    def held(self) -> bool:
        """Whether the run is paused and its steps are over."""
        return isinstance(self.clock, LiveClock) and self.clock.held

    def truths(self) -> Mapping[str, tuple[int, VehicleState]]:
        """Newest true states of vehicles and movable obstacles, with their times, ns; before the first instant none."""
        if self._states is None:
            return {}
        time_ns, states = self._states.time_ns, self._states.value
        assert isinstance(states, States)  # noqa: S101
        columns = (states.position, states.velocity, states.attitude, states.angular_velocity)
        truths: dict[str, tuple[int, VehicleState]] = {}
        for name, p, v, q, w in zip(states.names, *[each.tolist() for each in columns], strict=True):
            truths[name] = time_ns, VehicleState(position=(*p,), velocity=(*v,), attitude=(*q,), angular_velocity=(*w,))
        for name, (*place, yaw) in self._first.items():
            truths[name] = time_ns, VehicleState(position=(place[0], place[1], place[2]), attitude=quaternion_from_yaw(yaw))
        if self._pushed is not None:
            pushed = self._pushed.value
            assert isinstance(pushed, Pushed)  # noqa: S101
            for name, p, q in zip(pushed.names, pushed.position.tolist(), pushed.attitude.tolist(), strict=True):
                truths[name] = self._pushed.time_ns, VehicleState(position=(*p,), attitude=(*q,))
        return truths

    def go(self, *, paused: bool, steps: int = 0) -> None:
        """Pause the run, after so many steps, or continue it."""
        assert isinstance(self.clock, LiveClock)  # noqa: S101  `may_pause`
        self.clock.go(paused=paused, speed=self.clock.speed, step_ns=steps * seconds_to_ns(self.step_s))

    def move(self, obstacle: str, position: tuple[float, float], yaw: float) -> None:
        """Put an obstacle elsewhere at the next instant, as the operator of a control station does."""
        self._operator.ask(MoveTable(at_s=0.0, obstacle=obstacle, position=position, yaw=yaw))
