"""How far a study is: a bar on a terminal, a line every few seconds in a log."""

import time

from vcmvsp.cosim.terminal.progress import Shown, clock


class StudyProgress(Shown):
    """How far a study is, and within which bounds its first metric lies so far.

    Args:
        quiet: show nothing.
        what: it consists of.
    """

    def __init__(self, *, quiet: bool, what: str = "runs") -> None:
        super().__init__(quiet=quiet)
        self._what = what

    _first: int | None = None  # how many runs were done before
    _begin = 0.0
    _bounds: tuple[str, float, float] | None = None  # of the first metric

    def on_check(self, done: int, total: int) -> None:
        """Note how many points are checked before the first run."""
        self._show(f"checking: {done} of {total} points", done, total)

    def on_value(self, name: str, value: float) -> None:
        """Note the value of a metric in a run."""
        _, least, most = self._bounds or (name, value, value)
        self._bounds = name, min(least, value), max(most, value)

    def on_run(self, done: int, failed: int, total: int) -> None:
        """Note how many runs are done; the first call, with those that were done before, starts the clock."""
        now = time.monotonic()
        if self._first is None or done <= self._first:
            self._begin, self._first = now, done
        words = f"{done} of {total} {self._what} done" + (f", {failed} failed" if failed else "")
        if done > self._first:  # time left: as long for each as for those that are done
            words += f", {clock((now - self._begin) / (done - self._first) * (total - done))} left"
        if self._bounds is not None:
            name, least, most = self._bounds
            words += f", {name} {least:.3g} to {most:.3g}"
        self._show(words, done, total)

    def _show(self, words: str, done: int, total: int) -> None:
        if self._is_due():
            self._draw(done, total, words) if self._terminal else self.tell(words)
