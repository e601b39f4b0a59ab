"""Says which agent of this process computes without an end: nothing else would, since the run waits for it."""

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from vcmvsp.cosim.agent import Agent
from vcmvsp.cosim.util.text import Tell


class SlowAgents:
    """A thread beside the run that looks at what its thread does; it changes nothing of it.

    Args:
        now_ns: the time of the run.
        deadline_s: longer than this an agent may not compute without a word.
        tell: takes lines for the user.
    """

    def __init__(self, now_ns: Callable[[], int], deadline_s: float, tell: Tell) -> None:
        self._now_ns, self._deadline_s, self._tell = now_ns, deadline_s, tell
        self._run, self._over = threading.get_ident(), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        tick, since, told = ("", -1), time.monotonic(), False
        while not self._over.wait(min(self._deadline_s / 4, 1.0)):
            who, where = computing(sys._current_frames().get(self._run))  # noqa: SLF001  the only way to another thread's
            if (who, self._now_ns()) != tick:
                tick, since, told = (who, self._now_ns()), time.monotonic(), False
            elif who and not told and (for_s := time.monotonic() - since) > self._deadline_s:
                told = True
                self._tell(f"{who} has computed for {for_s:.0f} s, and still does ({where}); Ctrl-C twice ends the run at once")


def computing(frame: FrameType | None) -> tuple[str, str]:
    """Which agent computes in a thread, and where it is, both in words; empty: none does."""
    where = "" if frame is None else f"{Path(frame.f_code.co_filename).name} line {frame.f_lineno}, in {frame.f_code.co_name}"
    who = ""
    while frame is not None:
        agent, runner = frame.f_locals.get("self"), frame.f_back and frame.f_back.f_locals.get("self")
        if isinstance(agent, Agent) and (vehicle := getattr(runner, "vehicle", "")):
            who = f"agent {type(agent).__name__} of vehicle {vehicle}"
        frame = frame.f_back
    return who, where
