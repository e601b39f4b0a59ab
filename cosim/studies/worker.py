"""Runs of a study, wherever they are made: on this machine (`cosim.processes.worker_pool`) or by workers of a Dask scheduler.

Which workers a scheduler has, and what becomes of the runs of one that is lost, is its own business. Nothing else knows Dask.
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

_one_at_a_time = threading.Lock()  # a run has the process for itself, its current folder too


class WorkersGoneError(VcmvspError):
    """Those who make the runs are not to be had any more; what is done can be gone on with."""


class Work(msgspec.Struct, frozen=True):
    """What all runs of a study share."""

    scenario_toml: str
    folder: str  # where the scenario's files are
    version: str  # of vcmvsp, which must be the same everywhere
    agents: Literal["inprocess"] | None = None  # where agents run, if not where the scenario says
    files: dict[str, str] = {}  # SHA-256 of the files that the scenario names, as `Plan.files`


class Job(msgspec.Struct, frozen=True):
    """One run."""

    seed: int
    settings: dict[str, Any]


@functools.cache
def version() -> str:
    """Of vcmvsp, here."""
    return metadata.version("vcmvsp")


def run_one(work: Work, job: Job) -> bytes:
    """Run, and give a `Row` as JSON. Whatever goes wrong becomes a row with an error; nothing is raised."""
    try:
        if version() != work.version:
            return failed(f"this worker has vcmvsp {version()}, the study {work.version}")
        with _one_at_a_time, _in(work.folder):
            result = api.run(_content(work.scenario_toml), seed=job.seed, set=job.settings, agents=work.agents, mcap=False)
        for name, text in result.files.items():
            used = hashlib.sha256(text).hexdigest()
            if used not in work.files.get(name, used):
                return failed(f"{name} was changed while the study ran")
        return encode(Row(flat(result.metrics)))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return failed(str(error) if isinstance(error, VcmvspError) else words_of(error))


def failed(message: str) -> bytes:
    """The row of a run that failed."""
    return encode(Row(error=" ".join(message.split())))


DIED = failed("its worker died")


@functools.lru_cache(maxsize=4)
def _content(text: str) -> dict[str, Any]:
    return content(text)


def _in(folder: str) -> contextlib.AbstractContextManager[None]:
    """Relative files of a scenario lie in its folder, which a worker elsewhere need not have if there are none."""
    return contextlib.chdir(folder) if Path(folder).is_dir() else contextlib.nullcontext()


T = TypeVar("T")
TIMEOUT_S = 10  # for the scheduler, and then for what its workers say of their version
PER_THREAD = 4  # runs that are handed over at once: enough that no worker waits for us
LEAST = 8  # also to a cluster that has no workers yet, so that it knows that it needs some
LOOK_EVERY_S = 5.0
LOGGERS = ("distributed", "distributed.client", "tornado.application")  # what they tell of a lost cluster, we say
_ADDRESS = re.compile(r"([a-z]+://)?[^/\s]+:\d+")


class Cluster:
    """The workers of a scheduler. Use it as a context manager: leaving it takes back what is under way.

    Args:
        work: what all runs share.
        address: of the scheduler, e.g. ``tcp://10.0.0.1:8786``; or a cluster object of Dask's.

    Raises:
        UsageError: Dask is not installed, nobody answers, or workers have another version of vcmvsp.
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
        except Exception as error:  # what is no scheduler may answer anything, and Dask believes it
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

    def answers(self, asked: Iterable[Asked], count: int) -> Iterator[Answered]:
        """The ``count`` rows of these runs, in the order in which they become known.

        Raises:
            WorkersGoneError: the scheduler has died, or does not know the runs any more.
        """
        source, study = enumerate(asked), uuid.uuid4().hex
        running: dict[str, Run] = {}
        done = self._distributed.as_completed(loop=self._client.loop)
        while True:
            for number, (run, job) in islice(source, max(0, self._room() - len(running))):
                key = f"vcmvsp-{study}-{number}"
                future = self._ask(self._client.submit, run_one, self._work, job, key=key, pure=False)
                running[future.key] = run
                done.add(future)
            if not running:
                return
            future = self._ask(next, done)
            if future.status in ("lost", "pending"):  # its worker died with the answer: Dask makes the run again
                done.add(future)
            else:
                yield running.pop(future.key), self._answer(future)

    def _answer(self, future: Any) -> bytes:
        error = self._ask(future.exception)
        if error is None:
            answer: bytes = self._ask(future.result)
            return answer
        return DIED if isinstance(error, self._distributed.KilledWorker) else failed(f"{type(error).__name__}: {error}")

    def _ask(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """What Dask answers. Where the scheduler has died, it raises many kinds of errors, and of a cancelled future too."""
        try:
            return call(*arguments, **named)
        except Exception as error:
            raise WorkersGoneError(f"the cluster at {self._name} is gone") from error

    def _room(self) -> int:
        """How many runs may be under way; clusters grow and shrink."""
        if time.monotonic() - self._looked > LOOK_EVERY_S:
            self._capacity = max(LEAST, PER_THREAD * sum(self._ask(self._client.nthreads).values()))
            self._looked = time.monotonic()
        return self._capacity

    def _check_versions(self) -> None:
        try:
            found: dict[str, str] = _in_time(lambda: self._client.run(version))
        except Exception as error:  # whatever its workers make of it
            raise UsageError(
                f"--cluster {self._name}: a worker cannot run vcmvsp ({type(error).__name__}: {' '.join(str(error).split())})"
            ) from error
        others = {worker: theirs for worker, theirs in found.items() if theirs != self._work.version}
        for worker, theirs in others.items():
            raise UsageError(f"--cluster {self._name}: {worker} has vcmvsp {theirs}, this is {self._work.version}")


def _in_time(call: Callable[[], T]) -> T:
    """What the call gives within `TIMEOUT_S`. Dask waits without end for a peer that accepts a connection and says nothing.

    Raises:
        TimeoutError: it has given nothing by then; its thread is left behind.
    """
    given: list[T] = []
    raised: list[Exception] = []

    def make() -> None:
        try:
            given.append(call())
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(TIMEOUT_S)
    if raised:
        raise raised[0]
    if not given:
        raise TimeoutError("it says nothing")
    return given[0]
