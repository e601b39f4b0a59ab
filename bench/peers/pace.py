"""What every program of `bench.peers` is told, and how it is timed: by itself, a stretch of work whenever it is asked.

Standard library alone: the environment of the peers has nothing of ours.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import TextIO

BEAMS = 512
STATE = {
    "position": (1.1, 2.2, 0.3),
    "velocity": (0.1, 0.2, 0.3),
    "attitude": (0.7, 0.1, 0.1, 0.7),
    "angular_velocity": (0.1, 0.2, 0.3),
}
MESSAGE = "car007 12.5 -3.25 0.5"  # what is broadcast, where messages are compared
COMMAND = {"linear": (0.3, 0.1, 0.1), "yaw_rate": 0.3}


class Options(argparse.Namespace):
    """The star: a world, and so many agents in so many processes (0: in the world's own)."""

    agents: int
    processes: int
    scans: bool
    asked: int  # bytes that an agent is sent in a step, over our wire; of those who carry bytes
    answered: int  # bytes that it answers
    busy_s: float  # CPU time that each agent takes
    world_s: float  # CPU time that the world takes
    latency_s: float  # from what an agent sees to what its command does, for those that can overlap both
    stretch_s: float  # wall-clock time of a stretch
    span_s: float  # simulated time of a stretch, for those that have it so
    loss: float  # how likely a message is lost at each of its receivers
    way: str  # how it is done, of those that are measured in two ways
    at: str  # where a program's children find it


def options(arguments: Sequence[str] | None = None) -> Options:
    """What the program was started with."""
    parser = argparse.ArgumentParser()
    for name in ("agents", "processes", "asked", "answered"):
        parser.add_argument(f"--{name}", type=int, default=0)
    for name in ("busy_s", "world_s", "latency_s", "span_s", "loss"):
        parser.add_argument(f"--{name}", type=float, default=0.0)
    parser.add_argument("--stretch_s", type=float, default=0.3)
    parser.add_argument("--scans", action="store_true")
    parser.add_argument("--way", default="")
    parser.add_argument("--at", default="")
    return parser.parse_args(arguments, namespace=Options())


class Pace:
    """Told of each step; prints the wall-clock seconds of an agent-step of each stretch, and waits to be asked for the next.

    The first stretch warms up: whoever asks leaves its answer out.
    """

    def __init__(self, wanted: Options) -> None:
        self._answers = _answers()
        self._agents, self._stretch_s = wanted.agents, wanted.stretch_s
        self._steps = -1  # those of this stretch that are over
        self._begin = 0.0

    def step(self) -> bool:
        """Another step begins; False: no more are wanted."""
        now = time.perf_counter()
        self._steps += 1
        if self._steps and now - self._begin < self._stretch_s:
            return True
        if self._steps:
            print((now - self._begin) / self._steps / self._agents, file=self._answers, flush=True)
            if not sys.stdin.readline():
                return False
        self._steps, self._begin = 0, time.perf_counter()
        return True


def stretches(prepare: Callable[[Options], Callable[[], None]]) -> None:
    """Prepare some work, do it whenever asked, and print the CPU seconds of it; the first time, unasked, warms up."""
    answers = _answers()
    work = prepare(options())
    while True:
        begin = time.process_time()
        work()
        print(time.process_time() - begin, file=answers, flush=True)
        if not sys.stdin.readline():
            return


def _answers() -> TextIO:
    """Standard output; what libraries print there from now on is not for whoever reads the answers."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def busy(seconds: float) -> None:
    """Take so much CPU time of this thread."""
    if seconds:
        last = time.thread_time() + seconds
        while time.thread_time() < last:
            pass


def child(module: str, *arguments: str) -> "subprocess.Popen[bytes]":
    """Another process of a program, which ends with this one: its standard input closes."""
    return subprocess.Popen([sys.executable, "-m", module, *arguments], stdin=subprocess.PIPE)
