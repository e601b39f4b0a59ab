"""Where a run is to be shown: made by whoever starts the run, opened by the run once it knows what there is to show."""

from collections.abc import Callable
from types import TracebackType
from typing import Self

from vcmvsp.cosim.assembly.run import AssembledRun
from vcmvsp.cosim.clock import Clock, LiveClock
from vcmvsp.cosim.util.text import Tell
from vcmvsp.cosim.view.live.control import Live, may
from vcmvsp.cosim.view.live.server_process import Viewer
from vcmvsp.cosim.view.scenery import scenery_of


class Viewing:
    """The control station of one run. Use it as a context manager: leaving it closes the page.

    Args:
        host: what the page is served on; another than loopback lets other machines see it, unencrypted.
        port: likewise; 0: any that is free.
        opened: told the address of the page, with the token that lets one in.
    """

    def __init__(self, host: str, port: int, opened: Callable[[str], None]) -> None:
        self._host, self._port, self._opened = host, port, opened
        self._viewer: Viewer | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def live(self, run: AssembledRun, speed: float | None, *, stop: Callable[[], None], tell: Tell) -> Live:
        """Open the page of a run.

        Args:
            run: its federates.
            speed: simulated seconds per second at first; robots and programs at wall pace keep to that of their clock.
            stop: ends the run, as Ctrl-C does.
            tell: takes lines for the user.
        """
        world, keys = run.world, run.radio.adjustable()
        allowed = may(movables=world.movables, keys=tuple(keys), held_up=not run.has_outside)
        scenery = scenery_of(run.scenario, run.source, world=world, infos=run.agents, live=True, may=allowed, keys=keys)
        self._viewer = Viewer.open(
            scenery,
            self._host,
            port=self._port,
            moving={each.name: each.pose for each in world.moving},
            targets={each.name: each.place for each in world.targets},
        )
        self._opened(self._viewer.url)

        def clock(listen: Callable[[], None]) -> Clock:
            return run.clock if run.has_outside else LiveClock(speed, listen)

        return Live(self._viewer.feed, run.operator, clock=clock, stop=stop, tell=tell)

    def stay(self) -> None:
        """Leave the page open until Ctrl-C is pressed."""
        if self._viewer is not None:
            self._viewer.stay()

    def close(self) -> None:
        """Close the page. May be called again."""
        if self._viewer is not None:
            self._viewer.close()
