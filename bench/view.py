"""Cost of a control station to a run: with a page that reads, and with a stalled one.

``python -m bench.view`` prints the table. Medians of pairs: compare the ratios. Another core runs the process that serves the
page: CPU seconds of the run's process are the cost of reading, and wall-clock time shows that the run waits for no page.
"""

import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from bench.measure import Row, in_turn, measured, table
from bench.workloads import star
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.view.live.session import Viewing
from vcmvsp.cosim.view.scenery import scenery_of

VEHICLES, RUN_S, ROUNDS = 10, 60.0, 5
MOST = 1.10

PAGE = """
import sys, urllib.parse
from websockets.sync.client import connect
import viser
parts = urllib.parse.urlsplit(sys.argv[1])
token = urllib.parse.parse_qs(parts.query)["token"][0]
with connect(
    f"ws://{parts.netloc}/", origin=f"http://{parts.netloc}",
    subprotocols=[f"viser-v{viser.__version__}", f"token.{token}"], compression=None, max_size=None,
) as page:
    page.recv()
    print("here", flush=True)
    for _ in page:
        pass
"""


def rows() -> list[Row]:
    """All rows."""
    return measured((read, stalled))


def read() -> Row:
    """A page is connected, and reads everything."""
    with Viewing(port=0).open(_scenery()) as viewer:
        page = subprocess.Popen([sys.executable, "-c", PAGE, viewer.url], stdout=subprocess.PIPE)
        assert page.stdout is not None
        page.stdout.readline()
        try:
            return _row("with a page that reads, CPU time", viewer, time.process_time)
        finally:
            page.kill()
            page.communicate()


def stalled() -> Row:
    """The process that serves the page is stopped."""
    with Viewing(port=0).open(_scenery()) as viewer:
        os.kill(viewer._process.pid, signal.SIGSTOP)
        try:
            return _row("with a stalled viewer, wall-clock time", viewer, time.perf_counter)
        finally:
            os.kill(viewer._process.pid, signal.SIGCONT)


def _scenario() -> dict[str, Any]:
    return star(VEHICLES, physics="kinematic", duration_s=RUN_S)


def _scenery() -> Any:
    return scenery_of(*scenarios.load(_scenario()), live=True)


def _row(case: str, viewer: Viewing, clock: Callable[[], float]) -> Row:
    ours, other, ratio = in_turn(lambda: _run_s(viewer.feed.on, clock), lambda: _run_s(None, clock), ROUNDS)
    name = f"{VEHICLES} kinematic vehicles, 10 Hz, recorded, shown thirty times a second {case}; beside unseen"
    return Row(name, f"{RUN_S / ours:.0f} sim s / s", f"{RUN_S / other:.0f}", ratio, f"<= {MOST:g}x", ratio <= MOST)


def _run_s(observe: Callable[[Event], None] | None, clock: Callable[[], float]) -> float:
    """One run in this process, without set-up and files."""
    parsed, source = scenarios.load(_scenario())
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()
        recorder = assembled.recorder(None)

        def both(event: Event) -> None:
            recorder.on(event)
            if observe is not None:
                observe(event)

        begin = clock()
        kernel.run(both)
        seconds = clock() - begin
        recorder.close(kernel.now_ns)
        kernel.close()
    return seconds


def main() -> None:
    """Print the table."""
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores\n")
    print(table(rows()))


if __name__ == "__main__":
    main()
