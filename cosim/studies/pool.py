"""Runs on this machine: worker processes that are started afresh, each by itself, so that one that dies costs one run.

A thread waits for each worker. Workers are interpreters of their own rather than children of `multiprocessing`, which would
import the caller's script once more in each of them.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator

import msgspec

from cosim.errors import VcmvspError
from cosim.studies.plan import Run
from cosim.studies.worker import READY, Job, Work, failed
from cosim.transport.process import BOOT

ATTEMPTS = 2
DIED = failed("its worker died")
Asked = tuple[Run, Job]
Answered = tuple[Run, bytes]


class WorkerDiedError(Exception):
    """The process ended in the middle of a run."""


class Worker:
    """A process that makes one run after the other.

    Args:
        work: what all runs share.
    """

    def __init__(self, work: Work) -> None:
        # The worker looks for modules where this process does. A group of its own keeps Ctrl-C away from it.
        command = [sys.executable, "-P", "-c", BOOT.format(module="cosim.studies.worker")]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        try:
            ready = self._ask(json.dumps(sys.path).encode() + b"\n" + msgspec.json.encode(work))
        except WorkerDiedError:
            ready = b""
        if ready != READY:
            self.close()
            raise VcmvspError(f"a worker of the study ended while it started (exit code {self._process.returncode})")

    def run(self, job: Job) -> bytes:
        """A run's row.

        Raises:
            WorkerDiedError: the process was killed, or crashed.
        """
        return self._ask(msgspec.json.encode(job)).removesuffix(b"\n")

    def close(self) -> None:
        """End it, whatever it is doing; hosts of agents that it has started end by themselves then."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]  # both are pipes

    def kill(self) -> None:
        """End it while another thread waits for its answer."""
        self._process.kill()

    def _ask(self, line: bytes) -> bytes:
        stdin, stdout = self._process.stdin, self._process.stdout
        try:
            stdin.write(line + b"\n")  # type: ignore[union-attr]
            stdin.flush()  # type: ignore[union-attr]
            answer: bytes = stdout.readline()  # type: ignore[union-attr]
        except (OSError, ValueError) as error:
            raise WorkerDiedError from error
        if not answer.endswith(b"\n"):
            raise WorkerDiedError
        return answer


class Pool:
    """Workers of this machine. Use it as a context manager: leaving it ends them.

    Args:
        work: what all runs share.
        jobs: how many run at once.
    """

    def __init__(self, work: Work, jobs: int) -> None:
        self._work, self._jobs = work, jobs
        self._lock, self._stopped = threading.Lock(), False
        self._threads: list[threading.Thread] = []
        self._workers: set[Worker] = set()
        self._answers: queue.SimpleQueue[Answered | BaseException] = queue.SimpleQueue()

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._stopped = True
            for worker in self._workers:
                worker.kill()
        for thread in self._threads:
            thread.join()

    def answers(self, asked: Iterable[Asked], count: int) -> Iterator[Answered]:
        """The ``count`` rows of these runs, in the order in which they become known."""
        source = iter(asked)
        for _ in range(min(self._jobs, count)):
            self._threads.append(threading.Thread(target=self._serve, args=(source,), daemon=True))
            self._threads[-1].start()
        for _ in range(count):
            answer = self._answers.get()
            if isinstance(answer, BaseException):
                raise answer
            yield answer

    def _serve(self, source: Iterator[Asked]) -> None:
        """Keep one worker busy until nothing is left."""
        worker: Worker | None = None
        try:
            while (each := self._next(source)) is not None:
                run, job = each
                answer = DIED
                for _ in range(ATTEMPTS):
                    try:
                        worker = worker or self._started()
                        answer = worker.run(job)
                        break
                    except WorkerDiedError:
                        self._left(worker)
                        worker = None
                self._answers.put((run, answer))
        except BaseException as error:  # for the main thread to raise
            self._answers.put(error)
        finally:
            self._left(worker)

    def _next(self, source: Iterator[Asked]) -> Asked | None:
        with self._lock:
            return None if self._stopped else next(source, None)

    def _started(self) -> Worker:
        if self._stopped:
            raise WorkerDiedError
        worker = Worker(self._work)
        with self._lock:
            self._workers.add(worker)
            if self._stopped:
                worker.kill()
        return worker

    def _left(self, worker: Worker | None) -> None:
        if worker is not None:
            with self._lock:
                self._workers.discard(worker)
            worker.close()


def cores() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
