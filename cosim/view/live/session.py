"""Where a run is to be shown: made by whoever starts the run, opened by the run once it knows what there is to show."""

from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from vcmvsp.cosim.assembly.federates import Assembly
from vcmvsp.cosim.clock import Clock, LiveClock
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.scenario.schema import Scenario
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

    def live(
        self, scenario: Scenario, source: Source, assembly: Assembly, speed: float | None, *, paced: Clock | None = None
    ) -> Live:
        """Open the page of a run.

        Args:
            scenario: of the run.
            source: where it was read from.
            assembly: its federates.
            speed: simulated seconds per second at first.
            paced: what paces the run whatever somebody here wants, since robots or programs outside take part.
        """
        world: Any = assembly.world
        keys = assembly.air.adjustable()
        allowed = may(movables=world.movables, keys=tuple(keys), held_up=paced is None)
        scenery = scenery_of(scenario, source, world=world, infos=assembly.infos, live=True, may=allowed, keys=keys)
        self._viewer = Viewer.open(
            scenery,
            self._host,
            port=self._port,
            moving={each.name: each.pose for each in world.moving},
            targets={each.name: each.place for each in world.targets},
        )
        self._opened(self._viewer.url)
        live = Live(self._viewer.feed, assembly.operator)
        live.clock = LiveClock(speed, live.listen) if paced is None else paced
        return live

    def stay(self) -> None:
        """Leave the page open until Ctrl-C is pressed."""
        if self._viewer is not None:
            self._viewer.stay()

    def close(self) -> None:
        """Close the page. May be called again."""
        if self._viewer is not None:
            self._viewer.close()
