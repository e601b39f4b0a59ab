"""One run of a study, and the process that makes one after the other for `cosim.studies.pool`."""

import contextlib
import functools
import io
import os
import queue
import signal
import sys
import threading
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import msgspec

from cosim import api
from cosim.errors import VcmvspError
from cosim.studies.plan import content
from cosim.studies.rows import Row, encode, flat

READY = b"ready\n"
_one_at_a_time = threading.Lock()  # a run has the process for itself, its current folder too


class Work(msgspec.Struct, frozen=True):
    """What all runs of a study share."""

    scenario_toml: str
    folder: str  # where the scenario's files are
    version: str  # of vcmvsp, which must be the same everywhere
    agents: Literal["inprocess"] | None = None  # where agents run, if not where the scenario says


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
        return encode(Row(flat(result.metrics)))
    except (Exception, SystemExit) as error:
        kind = "" if isinstance(error, VcmvspError) else f"{type(error).__name__}: "
        return failed(f"{kind}{error}")


def failed(message: str) -> bytes:
    """The row of a run that failed."""
    return encode(Row(error=" ".join(message.split())))


@functools.lru_cache(maxsize=4)
def _content(text: str) -> dict[str, Any]:
    return content(text)


def _in(folder: str) -> contextlib.AbstractContextManager[None]:
    """Relative files of a scenario lie in its folder, which a worker elsewhere need not have if there are none."""
    return contextlib.chdir(folder) if Path(folder).is_dir() else contextlib.nullcontext()


def main() -> int:
    """Entry point of a worker process: a `Work` and then a `Job` a line come in, a `Row` a line goes out."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the study's to handle; it ends its workers
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what agents print is no answer
    pipe = io.FileIO(0, closefd=False)  # unbuffered: a thread that waits in it must not hold a lock when Python exits
    work = msgspec.json.decode(pipe.readline(), type=Work)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(pipe, lines), daemon=True).start()
    answers.write(READY)
    while True:
        answers.write(run_one(work, msgspec.json.decode(lines.get(), type=Job)) + b"\n")


def _read(pipe: io.FileIO, lines: "queue.SimpleQueue[bytes]") -> None:
    """Take jobs; leave at once, in the middle of a run too, when the study's process is gone: its end of the pipe closes."""
    while line := pipe.readline():
        lines.put(line)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
