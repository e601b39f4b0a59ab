"""Execute runs of a study: on this machine (`cosim.processes.worker_pool`) or on workers of a Dask scheduler.

The scheduler manages its workers and repeats the runs of lost ones. No other module uses Dask.
"""

import contextlib
import functools
import hashlib
import importlib
import logging
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from vcmvsp.cosim.endpoints import with_slash
from vcmvsp.cosim.errors import UsageError, VcmvspError, words_of
from vcmvsp.cosim.processes.worker_pool import Answered, Asked
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.studies.plan import Run, content
from vcmvsp.cosim.studies.rows import Row, encode, flat

_one_at_a_time = threading.Lock()  # a run needs the process and its current folder for itself


class WorkersGoneError(VcmvspError):
    """The workers are gone; the study can be resumed."""


class Work(msgspec.Struct, frozen=True):
    """Common data of all runs of a study."""

    scenario_toml: str
    folder: str  # base of the scenario's relative file names
    version: str  # of vcmvsp, equal on all workers
    agents: Literal["inprocess"] | None = None  # where agents run, overriding the scenario
    files: dict[str, str] = {}  # SHA-256 of the scenario's files, as `Plan.files`


class Job(msgspec.Struct, frozen=True):
    """One run."""

    seed: int
    settings: dict[str, Any]


@functools.cache
def version() -> str:
    """Version of vcmvsp on this machine."""
    return metadata.version("vcmvsp")


def run_one(work: Work, job: Job) -> bytes:
    """Execute a run and return its `Row` as JSON. Every error becomes a row with ``error``; nothing is raised."""
    try:
        if version() != work.version:
            return failed(f"this worker has vcmvsp {version()}, the study {work.version}: install the same version")
        with _one_at_a_time, _in(work.folder):
            result = api.run(_content(work.scenario_toml), seed=job.seed, set=job.settings, agents=work.agents, mcap=False)
        for name, text in result.files.items():
            used = hashlib.sha256(text).hexdigest()
            if used not in work.files.get(name, used):
                return failed(f"{name} changed during the study")
        return encode(Row(flat(result.metrics)))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return failed(str(error) if isinstance(error, VcmvspError) else words_of(error))


def failed(message: str) -> bytes:
    """The row of a failed run."""
    return encode(Row(error=" ".join(message.split())))


DIED = failed("its worker died")


_content = functools.lru_cache(maxsize=4)(content)


def _in(folder: str) -> contextlib.AbstractContextManager[None]:
    """Change to the scenario's folder, for relative file names; without effect if a remote worker lacks the folder."""
    return contextlib.chdir(folder) if Path(folder).is_dir() else contextlib.nullcontext()


T = TypeVar("T")
TIMEOUT_S = 10  # for the scheduler's answer, and then for the workers' versions
PER_THREAD = 4  # runs submitted in advance, so that no worker idles
LEAST = 8  # also for a cluster without workers, so that an adaptive one starts some
LOOK_EVERY_S = 5.0
LOGGERS = ("distributed", "distributed.client", "tornado.application")  # silenced: `Cluster` reports a lost cluster
_ADDRESS = re.compile(r"([a-z]+://)?[^/\s]+:\d+")


class Cluster:
    """The workers of a Dask scheduler. As a context manager it cancels pending runs at the end.

    Args:
        work: common data of all runs.
        address: of the scheduler, e.g. ``tcp://10.0.0.1:8786``; or a Dask cluster object.

    Raises:
        UsageError: Dask is not installed, the scheduler does not answer, or workers have another version of vcmvsp.
    """

    def __init__(self, work: Work, address: object) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise UsageError('--cluster needs Dask: in the checkout, pip install ".[cluster]"') from error
        if isinstance(address, str) and not _ADDRESS.fullmatch(address := with_slash(address).replace("/", "://", 1)):
            raise UsageError(f"--cluster {address}: must be the address of a Dask scheduler, e.g. tcp://10.0.0.1:8786")
        self._distributed, self._work, self._name = distributed, work, str(address)
        try:
            self._client: Any = _in_time(lambda: distributed.Client(address, timeout=f"{TIMEOUT_S}s", set_as_default=False))
        except Exception as error:  # another server may answer anything, and Dask does not check
            problem = f"no Dask scheduler answers there within {TIMEOUT_S} s"
            raise UsageError(f"--cluster {self._name}: {problem} ({' '.join(str(error).split())})") from error
        self._capacity, self._looked = LEAST, 0.0
        try:
            self._check_versions()
        except BaseException:
            self._client.close()
            raise

    def __enter__(self) -> "Cluster":
        self._levels = [(logger, logger.level) for logger in map(logging.getLogger, LOGGERS)]
        for logger, _ in self._levels:
            logger.setLevel(logging.CRITICAL)
        return self

    def __exit__(self, *error: object) -> None:
        self._client.close()
        for logger, level in self._levels:
            logger.setLevel(level)

    def answers(self, calls: Iterable[Asked], count: int) -> Iterator[Answered]:
        """The ``count`` rows of these runs, in order of completion.

        Raises:
            WorkersGoneError: the scheduler has died or no longer knows the runs.
        """
        source, study = enumerate(calls), uuid.uuid4().hex
        running: dict[str, Run] = {}
        futures = self._distributed.as_completed(loop=self._client.loop)
        while True:
            for number, (run, job) in islice(source, max(0, self._room() - len(running))):
                key = f"vcmvsp-{study}-{number}"
                future = self._ask(self._client.submit, run_one, self._work, job, key=key, pure=False)
                running[future.key] = run
                futures.add(future)
            if not running:
                return
            future = self._ask(next, futures)
            if future.status in ("lost", "pending"):  # its worker died with the answer: Dask repeats the run
                futures.add(future)
            else:
                yield running.pop(future.key), self._answer(future)

    def _answer(self, future: Any) -> bytes:
        error = self._ask(future.exception)
        if error is None:
            return self._ask(future.result)
        return DIED if isinstance(error, self._distributed.KilledWorker) else failed(f"{type(error).__name__}: {error}")

    def _ask(self, call: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call Dask; any of its errors, after a dead scheduler or a cancelled future, becomes `WorkersGoneError`."""
        try:
            return call(*arguments, **keywords)
        except Exception as error:
            raise WorkersGoneError(f"the cluster at {self._name} is gone") from error

    def _room(self) -> int:
        """Number of runs that may be pending, by the present size of the cluster."""
        if time.monotonic() - self._looked > LOOK_EVERY_S:
            self._capacity = max(LEAST, PER_THREAD * sum(self._ask(self._client.nthreads).values()))
            self._looked = time.monotonic()
        return self._capacity

    def _check_versions(self) -> None:
        try:
            versions: dict[str, str] = _in_time(lambda: self._client.run(version))
        except Exception as error:  # a worker may raise anything
            raise UsageError(
                f"--cluster {self._name}: a worker cannot run vcmvsp ({type(error).__name__}: {' '.join(str(error).split())})"
            ) from error
        others = {worker: installed for worker, installed in versions.items() if installed != self._work.version}
        for worker, installed in others.items():
            raise UsageError(f"--cluster {self._name}: {worker} has vcmvsp {installed}, this is {self._work.version}")


def _in_time(call: Callable[[], T]) -> T:
    """Result of a call within `TIMEOUT_S`: Dask itself waits forever for a peer that accepts a connection and stays silent.

    Raises:
        TimeoutError: no result in time; the thread keeps running.
    """
    answers: list[T] = []
    raised: list[Exception] = []

    def make() -> None:
        try:
            answers.append(call())
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(TIMEOUT_S)
    if raised:
        raise raised[0]
    if not answers:
        raise TimeoutError("it says nothing")
    return answers[0]
