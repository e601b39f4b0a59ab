"""Pool of worker processes for many calls of a function on this machine; a worker that dies costs one call.

A thread waits for each worker. Workers are not children of `multiprocessing`, which would import the caller's script again in
each of them. Functions, arguments and results travel as pickles.
"""

import contextlib
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

from vcmvsp.cosim.errors import VcmvspError, words_of
from vcmvsp.cosim.processes.child_process import ChildProcess
from vcmvsp.cosim.processes.fork_server import ForkServer

ATTEMPTS = 2  # attempts of a call
STARTS = 10  # of a worker, before repeated kills count as an error
READY = "ready"
MODULE = "vcmvsp.cosim.processes.worker_pool"
Asked = tuple[Any, Any]  # the caller's key of a call, and the argument
Answered = tuple[Any, Any]  # the same key, and the result


class WorkerDiedError(Exception):
    """The worker process ended during a call."""


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise VcmvspError(f"cannot start a worker: {error.strerror or error}") from error


class Worker:
    """A process that makes one call after the other.

    Args:
        start: starts processes of this module.
    """

    _ready = False

    def __init__(self, call: Callable[[Any], Any], start: Callable[..., ChildProcess]) -> None:
        with _starting():
            own_end, child_end = socket.socketpair()
            self._pipe: Connection[Any, Any] = Connection(own_end.detach())
            with child_end:
                self._process = start(stdin=child_end.fileno())
        with contextlib.suppress(OSError):  # the worker has ended, which `await_ready` reports
            self._pipe.send_bytes(pickle.dumps(call))

    def await_ready(self) -> None:
        """Wait until the worker has started; `run` does so, too.

        Raises:
            WorkerDiedError: the worker was killed from outside while it started.
            VcmvspError: it failed by itself.
        """
        if self._ready:
            return
        with contextlib.suppress(WorkerDiedError):
            self._ready = self._answer() == READY
        if not self._ready:
            self.close()
            if self._process.returncode == -signal.SIGKILL:  # treated like a later kill
                raise WorkerDiedError
            raise VcmvspError(f"a worker ended while it started (exit code {self._process.returncode})")

    def run(self, argument: object) -> Any:
        """The function's result or exception. Raises `WorkerDiedError` (the process was killed, or crashed)."""
        request = pickle.dumps(argument)
        self.await_ready()
        try:
            self._pipe.send_bytes(request)
        except OSError as error:
            raise WorkerDiedError from error
        return self._answer()

    def _answer(self) -> Any:
        try:
            answer = self._pipe.recv_bytes()
        except (EOFError, OSError) as error:
            raise WorkerDiedError from error
        raised, value = pickle.loads(answer)  # noqa: S301  by a process of our own
        if raised:
            raise value
        return value

    def close(self) -> None:
        """Kill the worker, also during a call; hosts of agents that it has started end by themselves then."""
        self._process.kill()
        self._process.wait()
        self._pipe.close()

    def kill(self) -> None:
        """Kill the worker while another thread waits for its answer."""
        self._process.kill()


class Pool:
    """Worker processes of this machine. Use it as a context manager: leaving it ends them.

    Args:
        call: a function of a module, or a `functools.partial` of one.
        jobs: number of parallel calls.
        died: result of a call whose worker died twice; an exception is raised.
        imports: modules that a call needs, besides its own; they must start no thread when they are imported.
    """

    def __init__(self, call: Callable[[Any], Any], jobs: int, *, died: object, imports: Sequence[str] = ()) -> None:
        self._call, self._jobs, self._died = call, jobs, died
        self._server = ForkServer(MODULE, *imports, stdout=subprocess.DEVNULL)
        self._lock, self._stopped = threading.Lock(), False
        self._threads: list[threading.Thread] = []
        self._workers: set[Worker] = set()
        self._answers: queue.SimpleQueue[Answered | BaseException] = queue.SimpleQueue()

    def __enter__(self) -> "Pool":
        with _starting():
            self._server.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._stopped = True
            for worker in self._workers:
                worker.kill()
        for thread in self._threads:
            thread.join()
        self._server.__exit__(*error)

    def answers(self, calls: Iterable[Asked], count: int) -> Iterator[Answered]:
        """The results of these ``count`` calls in the order of completion; the first exception ends it."""
        source = iter(calls)
        for _ in range(min(self._jobs, count)):
            self._threads.append(threading.Thread(target=self._serve, args=(source,), daemon=True))
            self._threads[-1].start()
        for _ in range(count):
            answer = self._answers.get()
            if isinstance(answer, BaseException):
                raise answer
            yield answer

    def _serve(self, source: Iterator[Asked]) -> None:
        worker: Worker | None = None
        try:
            while (each := self._next(source)) is not None:
                name, argument = each
                answer = self._died
                for _ in range(ATTEMPTS):
                    try:
                        worker = worker or self._started()
                        answer = worker.run(argument)
                        break
                    except WorkerDiedError:
                        self._discard(worker)
                        worker = None
                self._answers.put(answer if isinstance(answer, BaseException) else (name, answer))
        except BaseException as error:  # raised in the main thread
            self._answers.put(error)
        finally:
            self._discard(worker)

    def _next(self, source: Iterator[Asked]) -> Asked | None:
        with self._lock:
            return None if self._stopped else next(source, None)

    def _started(self) -> Worker:
        """A new worker. A kill during the start does not count as a failed call."""
        for _ in range(STARTS):
            if self._stopped:
                raise WorkerDiedError
            with contextlib.suppress(WorkerDiedError):
                worker = Worker(self._call, self._server.start)
                worker.await_ready()
                with self._lock:
                    self._workers.add(worker)
                    if self._stopped:
                        worker.kill()
                return worker
        raise VcmvspError(f"{STARTS} workers in a row were killed during their start")

    def _discard(self, worker: Worker | None) -> None:
        if worker is not None:
            with self._lock:
                self._workers.discard(worker)
            worker.close()


def cores() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- worker process -------------------------------------------------------------------------------------------------------


def main() -> int:
    """Entry point of a worker process: reads the function, then one argument after the other."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller handles Ctrl-C and ends its workers
    pipe: Connection[Any, Any] = Connection(os.dup(0))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # processes started by a call neither hold nor read this end
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(pipe, lines), daemon=True).start()
    call = pickle.loads(lines.get())  # noqa: S301  from the process that started us
    pipe.send_bytes(pickle.dumps((False, READY)))
    while True:
        pipe.send_bytes(_answer(call, lines.get()))


def _read(pipe: "Connection[Any, Any]", lines: "queue.SimpleQueue[bytes]") -> None:
    """Read calls; exit at once, also during a call, when the caller's process is gone and its end of the pipe closes."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            lines.put(pipe.recv_bytes())
    os._exit(0)


def _answer(call: Callable[[Any], Any], request: bytes) -> bytes:
    try:
        return pickle.dumps((False, call(pickle.loads(request))))  # noqa: S301
    except Exception as error:
        return pickle.dumps((True, _portable(error)))


def _portable(error: Exception) -> Exception:
    """The error if it can be pickled; otherwise a substitute with its text."""
    if not isinstance(error, VcmvspError):
        error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301
    except Exception:  # arbitrary errors and their contents may not be picklable
        return VcmvspError(str(error) if isinstance(error, VcmvspError) else words_of(error))
    return error


if __name__ == "__main__":
    sys.exit(main())
