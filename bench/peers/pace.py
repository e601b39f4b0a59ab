"""Options and timing of the programs of `bench.peers`: each times itself, a stretch of work per request.

Standard library alone: the environment of the peers contains none of our packages.
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
MESSAGE = "car007 12.5 -3.25 0.5"  # broadcast content, where messages are compared
COMMAND = {"linear": (0.3, 0.1, 0.1), "yaw_rate": 0.3}


class Options(argparse.Namespace):
    """The star: a world, and agents in a number of processes (0: in the world's own)."""

    agents: int
    processes: int
    scans: bool
    asked: int  # bytes to an agent in a step, over our wire; for peers that carry bytes
    answered: int  # bytes of its answer
    busy_s: float  # CPU time of each agent's step
    world_s: float  # CPU time of the world's step
    latency_s: float  # from an agent's observation to its command's effect, where both can overlap
    stretch_s: float  # wall-clock time of a stretch
    span_s: float  # simulated time of a stretch, where it is set
    loss: float  # probability of losing a message at each of its receivers
    way: str  # mode, of programs with several
    at: str  # endpoint for a program's children


def options(arguments: Sequence[str] | None = None) -> Options:
    """Options on the program's command line."""
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
    """Called at each step; prints the wall-clock seconds of an agent-step of each stretch, and waits for the next request.

    The first stretch warms up: its result is ignored.
    """

    def __init__(self, settings: Options) -> None:
        self._answers = _answers()
        self._agents, self._stretch_s = settings.agents, settings.stretch_s
        self._steps = -1  # finished steps of this stretch
        self._begin = 0.0

    def step(self) -> bool:
        """Begin another step; False: the program is to end."""
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
    """Prepare some work, do it on each request, and print its CPU seconds; a first, unrequested stretch warms up."""
    answers = _answers()
    work = prepare(options())
    while True:
        begin = time.process_time()
        work()
        print(time.process_time() - begin, file=answers, flush=True)
        if not sys.stdin.readline():
            return


def _answers() -> TextIO:
    """Original standard output; later output of libraries must not reach the reader of the answers."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def busy(seconds: float) -> None:
    """Take CPU time, s, of this thread."""
    if seconds:
        last = time.thread_time() + seconds
        while time.thread_time() < last:
            pass


def child(module: str, *arguments: str) -> "subprocess.Popen[bytes]":
    """Another process of a program, which ends with this one: its standard input closes."""
    return subprocess.Popen([sys.executable, "-m", module, *arguments], stdin=subprocess.PIPE)
