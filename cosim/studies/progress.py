"""How far a study is: a bar on a terminal, a line every few seconds in a log."""

import time

from cosim.progress import Shown


class StudyProgress(Shown):
    """How far a study is."""

    _first: int | None = None  # how many runs were done before

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
        if self._is_due():
            self._draw(done, total, words) if self._terminal else self.tell(words)


def clock(seconds: float) -> str:
    """A duration as one reads it: ``40 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
