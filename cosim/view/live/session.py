"""Live control station of a run: its process, its feed, and execution of its orders.

Orders are executed in the run's own thread, between two instants or during a pause, and never disturb a step.
"""

import contextlib
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from vcmvsp.cosim.assembly.interventions import Operator
from vcmvsp.cosim.assembly.run import AssembledRun, Parts
from vcmvsp.cosim.clock import LISTEN_NS, Clock, LiveClock
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.processes.child_process import ChildProcess
from vcmvsp.cosim.scenario.schema import InterventionTable
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.util.text import Tell
from vcmvsp.cosim.view import HOST
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import Feed, Places, Poses, motions_of
from vcmvsp.cosim.view.messages import End, Go, Order, Pace, Scenery
from vcmvsp.cosim.view.scenery import crafts_of, scenery_of
from vcmvsp.cosim.view.web_server import new_token, url_of

START_S = 60.0  # time for the page to start
RELAY_S = 10.0  # time for the page to take an update
LEAVE_S = 3.0  # time for the process to exit by itself
MODULE = "vcmvsp.cosim.view.live.server"


class Viewing(contextlib.AbstractContextManager["Viewing"]):
    """The control station of one run, opened once the run's parts are built: the process that serves its page.

    Leaving the context ends the process.

    Args:
        host: address of the page; any other than loopback exposes the page to other machines, unencrypted.
        port: port of the page; 0: any free one.
        opened: receives the URL of the page, with its access token.
    """

    url: str
    feed: Feed
    _process: ChildProcess
    _pipe: protocol.Pipe | None = None  # None: not opened yet

    def __init__(self, host: str = HOST, port: int = 0, opened: Callable[[str], None] = lambda _: None) -> None:
        self._host, self._port, self._opened = host, port, opened

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is not None and self._pipe is not None and not self.feed.over:
            self.feed.close(str(error) or "interrupted")
        self.close()

    def prepare(self, parts: Parts) -> None:
        """Open the page of a run whose agents have not joined."""
        world, keys = parts.world, {key: value for each in parts.radios for key, value in each.adjustable().items()}
        allowed = {"sensors": True, "halt": True, "outage": True, "end": True}
        allowed |= {"move": bool(world.movables), "set": bool(keys), "pace": not parts.has_outside}
        may = tuple(order for order, is_obeyed in allowed.items() if is_obeyed)
        scenery = scenery_of(parts.scenario, parts.source, world=world, live=True, may=may, keys=keys)
        self.open(scenery, **motions_of(world))
        self.feed.pace(Pace(waiting="its agents"))

    def live(self, run: AssembledRun, speed: float | None, *, stop: Callable[[], None], tell: Tell, clock: Clock) -> "Live":
        """Show a run whose agents have joined, on the page that `prepare` has opened.

        ``clock``: of a run in which robots, stacks or programs take part; others get one that can pause.
        """
        self.feed.describe(crafts_of(run.scenario, run.source, infos=run.agents))

        def paced(listen: Callable[[], None]) -> Clock:
            return clock if run.has_outside else LiveClock(speed, listen)

        return Live(self.feed, run.operator, clock=paced, stop=stop, tell=tell)

    def open(self, scenery: Scenery, *, moving: Poses | None = None, targets: Places | None = None) -> Self:
        """Start the process and wait for the page; arguments as of `Feed`.

        Raises:
            UsageError: the page cannot be served at this address, or its process does not start.
        """
        token = new_token()
        pipe, child_end = protocol.pair()
        with child_end:
            self._process = ChildProcess(MODULE, str(child_end.fileno()), files=(child_end.fileno(),))
        self._pipe = pipe
        start = protocol.Start(scenery=scenery, host=self._host, port=self._port, token=token)
        try:
            port = _up(self._process, pipe, start).port
        except BaseException:
            self.close()
            raise
        self.url, self.feed = url_of(self._host, port, token), Feed(pipe, scenery, moving=moving, targets=targets)
        self._opened(self.url)
        return self

    def relay(self, update: bytes) -> None:
        """Show an encoded update of another run's page (`cosim.view.live.broadcast`)."""
        if self._pipe is None or not self._pipe.offer_within(update, RELAY_S):
            raise UsageError("the control station disconnected")
        self._pipe.take()  # choices of sensors have no effect there

    def stay(self) -> None:
        """Wait until the process ends or Ctrl-C is pressed: the page stays usable after the run."""
        if self._pipe is not None:
            with contextlib.suppress(KeyboardInterrupt):
                self._process.wait()

    def close(self) -> None:
        """End the process. Repeated calls are allowed."""
        if self._pipe is not None:
            self._pipe.close()
            self._process.close(LEAVE_S)
            self._pipe = None


class Live:
    """Connects a run with its feed; only a `LiveClock` can be paused."""

    def __init__(
        self,
        feed: Feed,
        operator: Operator,
        *,
        clock: Callable[[Callable[[], None]], Clock],
        stop: Callable[[], None],
        tell: Tell,
    ) -> None:
        self._feed, self._operator, self._stop, self._tell = feed, operator, stop, tell
        self.on, self.close = feed.on, feed.close
        self.clock = clock(self.listen)
        self._listened_ns, self._alone = 0, False

    def on_instant(self, now_ns: int) -> None:
        """Read orders if `LISTEN_NS` have passed: a clock other than `LiveClock` does not read them."""
        if time.monotonic_ns() - self._listened_ns >= LISTEN_NS:
            self.listen()

    def listen(self) -> None:
        """Execute the pending orders."""
        self._listened_ns = time.monotonic_ns()
        for order in self._feed.orders():
            try:
                self._obey(order)
            except ValueError as error:
                self._feed.say("warning", f"not done: {error}")
        paused = isinstance(self.clock, LiveClock) and self.clock.paused
        self._feed.pace(Pace(paused=paused, speed=self.clock.speed))
        if not self._feed.open and not self._alone:
            self._alone = True
            self._tell(f"the control station disconnected{self._feed.problem and f': {self._feed.problem}'}; the run continues")
            if isinstance(self.clock, LiveClock) and self.clock.paused:  # no viewer is left to resume the run
                self.clock.go(paused=False, speed=self.clock.speed)

    def _obey(self, order: Order) -> None:
        if isinstance(order, Go):
            if not isinstance(self.clock, LiveClock):
                raise ValueError("robots and external programs need the wall clock")  # noqa: TRY004  it is a wish, not a type
            self.clock.go(paused=order.paused, speed=_checked(order.speed), step_ns=max(0, order.step_ns))
        elif isinstance(order, End):
            self._stop()
        elif isinstance(order, InterventionTable):
            self._operator.ask(order)


def _checked(speed: float | None) -> float | None:
    if speed is not None and not 1e-3 <= speed <= 1e6:
        raise ValueError(f"the speed must be between 0.001 and 1 000 000, not {speed:g}")
    return speed


def _up(process: ChildProcess, pipe: protocol.Pipe, start: protocol.Start) -> protocol.Up:
    until_s = time.monotonic() + START_S
    pipe.offer_within(codec.encode(start), START_S)
    while (left_s := until_s - time.monotonic()) > 0.0:
        for message in pipe.take(wait_s=min(left_s, 0.2)):
            answer = protocol.answers.decode(message)
            if isinstance(answer, protocol.Up):
                return answer
            if isinstance(answer, protocol.Down):
                raise UsageError(answer.problem)
        if not pipe.open:
            ended = process.why_ended(LEAVE_S) or "has gone"
            raise UsageError(f"the process of the view {ended} before its page was ready")
    raise UsageError(f"the page of the view was not ready within {START_S:g} s")
