"""Gain by a second core: on shared machines two cores do less than twice the work of one."""

import functools
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

TURNS = 20
ROUNDS = 3
Prepare = Callable[[], Callable[[], None]]
"""Prepares some work, in the process that will do it."""


def gain(prepare: Prepare) -> float:
    """Work of two processes on a core each, in units of the work of one process in the same time.

    Raises:
        ValueError: there is one core only.
    """
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise ValueError("there is one core only")
    return 2.0 * _wall_s(prepare, cores[:1]) / _wall_s(prepare, cores[:2])


@functools.cache
def gain_of_integers() -> float:
    """Gain of a loop over integers, which needs only a processor: median of `ROUNDS`, at most 2."""
    return min(2.0, statistics.median(gain(integers) for _ in range(ROUNDS)))


def integers() -> Callable[[], None]:
    """Work that needs only a processor."""

    def add() -> None:
        total = 0
        for number in range(1_000_000):
            total += number * number

    return add


def _wall_s(prepare: Prepare, cores: Sequence[int]) -> float:
    """Wall-clock time of the slowest of some processes, each on a core of its own."""
    context = multiprocessing.get_context("spawn")
    barrier, took_s = context.Barrier(len(cores)), context.Queue()
    children = [context.Process(target=_rounds, args=(prepare, core, barrier, took_s)) for core in cores]
    for child in children:
        child.start()
    slowest = max(took_s.get(timeout=120.0) for _ in children)
    for child in children:
        child.join()
    return slowest


def _rounds(prepare: Prepare, core: int, barrier: Any, took_s: Any) -> None:
    os.sched_setaffinity(0, {core})
    work = prepare()
    work()
    barrier.wait()
    begin = time.perf_counter()
    for _ in range(TURNS):
        work()
    took_s.put(time.perf_counter() - begin)
