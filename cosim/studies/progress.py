"""How far a study is: a bar on a terminal, a line every few seconds in a log."""

import sys
import time
from types import TracebackType
from typing import Any, Self

from cosim.progress import DRAW_EVERY_S, LOG_EVERY_S


class StudyProgress:
    """Progress on stderr.

    Args:
        quiet: show nothing.
    """

    def __init__(self, *, quiet: bool) -> None:
        self._terminal = sys.stderr.isatty() and not quiet
        self._quiet = quiet
        self._bar: Any = None
        self._task: Any = None
        self._start = self._last = time.monotonic()
        self._first: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def on_check(self, done: int, total: int) -> None:
        """Note how many points are checked before the first run."""
        self._show(f"checking: {done} of {total} points", done, total)

    def on_run(self, done: int, failed: int, total: int) -> None:
        """Note how many runs are done; the first call, with those that were done before, starts the clock."""
        now = time.monotonic()
        if self._first is None or done <= self._first:
            self._start, self._first = now, done
        words = f"{done} of {total} runs done" + (f", {failed} failed" if failed else "")
        if done > self._first:  # time left: as long for each as for those that are done
            words += f", {clock((now - self._start) / (done - self._first) * (total - done))} left"
        self._show(words, done, total)

    def _show(self, words: str, done: int, total: int) -> None:
        now = time.monotonic()
        if self._quiet or now - self._last < (DRAW_EVERY_S if self._terminal else LOG_EVERY_S):
            return
        self._last = now
        if self._terminal:
            self._draw(words, done, total)
        else:
            sys.stderr.write(f"{words}\n")
            sys.stderr.flush()

    def _draw(self, words: str, done: int, total: int) -> None:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (BarColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("")
            self._bar.start()
        self._bar.update(self._task, completed=done, total=total, description=words)


def clock(seconds: float) -> str:
    """A duration as one reads it: ``40 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
