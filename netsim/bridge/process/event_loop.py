"""An asyncio loop whose timers are good to microseconds: asyncio's own rounds each wait up to a whole millisecond."""

import asyncio
import selectors

from vcmvsp.cosim.util.polling import readable


class FineSelector(selectors.EpollSelector):
    """As ``EpollSelector``, with waits in microseconds."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for readiness, at most ``timeout`` s (None: as long as it takes)."""
        if timeout is not None and timeout > 0.0:
            readable([self.fileno()], timeout)  # its own descriptor is readable when something is ready
            timeout = 0.0
        return super().select(timeout)


def new_loop() -> asyncio.AbstractEventLoop:
    """Such a loop; whoever makes it closes it."""
    return asyncio.SelectorEventLoop(FineSelector())
