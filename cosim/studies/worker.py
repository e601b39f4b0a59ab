"""One run of a study, wherever it is made: by `cosim.processes.worker_pool` on this machine, or by `cosim.studies.cluster`."""

import contextlib
import functools
import hashlib
import threading
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import msgspec

from vcmvsp.cosim.errors import VcmvspError, words_of
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.studies.plan import content
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
