"""A study's folder: one table that is readable at any moment, and nothing lost by whatever ends the study.

``study.toml`` says what is run and is written first. A finished run is a line of ``study.journal`` at once; now and then the
table ``study.parquet`` is written anew, beside the old one and then in its place, and the journal is emptied. That is done so
rarely that it takes less than a fiftieth of the time, however large the table. In the end there is no journal.

Whatever ends the process loses nothing. A power cut may: as runs finish, the journal is written through to the disk at most
five times a second; the system writes the rest within seconds. What a cut takes is run again. Plan and table are on the disk
before they take the place of those before them.
"""

import contextlib
import errno
import fcntl
import os
import platform
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import msgspec
import pyarrow as pa

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.studies import rows
from vcmvsp.cosim.studies.plan import Plan, check_same
from vcmvsp.cosim.tables.schema import read_table, write_table
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.files import PART, Folder, replacing, writing

PLAN, TABLE, JOURNAL, LOCK = "study.toml", "study.parquet", "study.journal", "study.lock"
FIGURES = tuple(f"{name}.{kind}" for name in ("study", "study-map") for kind in ("png", "svg"))
OUTPUTS = ("about.json", "summary.csv", "report.html", *FIGURES)
SHARE = 0.02  # of the time may go into writing the table, and as much into waiting for the disk
SYNC_EVERY_S = 0.2  # at the most often: the journal, to the disk


class JournalLine(msgspec.Struct, frozen=True):
    """A line of the journal."""

    run: str
    row: msgspec.Raw


class Answers:
    """What the runs gave, in memory."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.rows: dict[str, bytes] = {}  # by `Run.key`, packed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Nothing is held."""

    def add(self, run: str, row: bytes) -> None:
        """Keep a run's row."""
        self.rows[run] = rows.packed(row)

    def finish(self) -> pa.Table:
        """The table of all runs."""
        return rows.table_of(self.plan, self.rows)


def begun(folder: Path, *, resume: bool, force: bool) -> Plan | None:
    """The plan of the study that a folder holds and that is to go on; None: a new one begins there.

    Raises:
        UsageError: the folder holds something, and it is not said what to do with that.
    """
    found = folder.iterdir() if folder.is_dir() else ()
    there = {path.name for path in found if path.name != LOCK and path.suffix != PART}  # which one leaves that was killed
    if force or not there:
        Folder(folder, force=True)  # whether it can be written
        return None
    if PLAN not in there:
        why = "holds no study" if resume else "is not empty; give another folder, or --force to overwrite"
        raise UsageError(f"--out {folder}: {why}")
    plan = Plan.read(folder / PLAN)
    if not resume:
        what = "--resume to go on with it, --force to begin anew"
        raise UsageError(f"--out {folder}: holds a study of {plan.scenario} already: {what}, or give another folder")
    return plan


class Store(Answers):
    """The same, in a folder. Use it as a context manager: meanwhile no other study can write there.

    Args:
        resume: go on with what is there, which must be the same study.
        force: begin anew, whatever is there.
    """

    def __init__(self, folder: Path, plan: Plan, *, resume: bool, force: bool) -> None:
        super().__init__(plan)
        self._folder, self._resume, self._force = folder, resume, force
        self._next = self._sync = 0.0
        self._journal: IO[bytes]

    def __enter__(self) -> Self:
        with writing(self._folder), contextlib.ExitStack() as stack:
            self._folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(_locked(self._folder / LOCK))
            for left in self._folder.glob(f".*{PART}"):
                shutil.rmtree(left, ignore_errors=True)  # of a study that was killed
            if stored := begun(self._folder, resume=self._resume, force=self._force):
                check_same(self.plan, stored, self._folder)
                self._recover(stored)
            else:
                for name in (TABLE, JOURNAL, *OUTPUTS):
                    (self._folder / name).unlink(missing_ok=True)
            with replacing(self._folder / PLAN, durable=True) as path:
                path.write_bytes(self.plan.to_toml().encode())
            self._journal = stack.enter_context(_opened(self._folder / JOURNAL, "ab"))
            self.write()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Let go of the folder; what has been added so far is in its table."""
        with self._stack:
            if error is not None:
                with contextlib.suppress(OSError):  # what is in the journal is not lost
                    self.write()

    def add(self, run: str, row: bytes) -> None:
        """Keep a run's row, in the journal at once."""
        super().add(run, row)
        with writing(self._folder):
            self._journal.write(msgspec.json.encode(JournalLine(run, msgspec.Raw(row))) + b"\n")
            begin = time.monotonic()
            if begin >= self._next:
                self.write()
            elif begin >= self._sync:
                os.fsync(self._journal.fileno())
                end = time.monotonic()
                self._sync = end + max(SYNC_EVERY_S, (end - begin) / SHARE)

    def write(self) -> pa.Table:
        """Write the table of all rows so far."""
        begin = time.monotonic()
        table = rows.table_of(self.plan, self.rows)
        with replacing(self._folder / TABLE, durable=True) as path:
            write_table(table, path)
        self._journal.truncate(0)
        end = time.monotonic()
        self._next = end + (end - begin) / SHARE
        return table

    def finish(self) -> pa.Table:
        """Write the table of all runs; the journal goes."""
        with writing(self._folder):
            table = self.write()
            (self._folder / JOURNAL).unlink()
        return table

    def _recover(self, stored: Plan) -> None:
        """Take the rows that are there: of the table, and of those lines of the journal that can be read."""
        wanted = {run.key for run in self.plan.runs}
        try:
            if (self._folder / TABLE).exists():
                self.rows |= rows.answers_of(read_table(self._folder / TABLE), list(stored.vary))
            lines = list(_journal(self._folder))
        except (OSError, ValueError, KeyError) as error:
            problem = " ".join(str(error).split())
            raise UsageError(f"--resume {self._folder}: its rows cannot be read: {problem}") from error
        for told in lines:
            if rows.decode(told.row).error is None:  # failed runs are run again
                self.rows[told.run] = rows.packed(bytes(told.row))
        self.rows = {run: row for run, row in self.rows.items() if run in wanted}


def so_far(folder: Path, plan: Plan) -> pa.Table:
    """The table of a study that is in a folder, with what only its journal has yet: it may be cut, or go on.

    Raises:
        UsageError: it cannot be read.
    """
    try:  # the journal first: it is emptied once the table has what stands in it
        answers = {line.run: rows.packed(bytes(line.row)) for line in _journal(folder)}
        table = read_table(folder / TABLE) if (folder / TABLE).exists() else rows.table_of(plan, {})
        if not answers:
            return table
        return rows.table_of(plan, rows.answers_of(table, list(plan.vary), failed=True) | answers)
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{folder}: its rows cannot be read: {' '.join(str(error).split())}") from error


def _journal(folder: Path) -> Iterator[JournalLine]:
    text = limits.read_bytes(folder / JOURNAL, limits.CSV_BYTES) if (folder / JOURNAL).exists() else b""
    limits.within(text.count(b"\n"), limits.MESSAGES, f"lines in {JOURNAL}")
    for line in text.split(b"\n"):
        with contextlib.suppress(ValueError):  # half a line, or what a power cut left of one: it is run again
            yield read_json(line, JournalLine)


def _opened(path: Path, mode: str) -> IO[bytes]:
    """A file that is written in place, without a buffer; what a link points to is left alone."""
    try:
        return open(path, mode, 0, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise UsageError(f"{path}: is a link, which no study writes through: remove it") from error


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a folder; the system lets go of it for a process that dies."""
    while True:
        file = _opened(path, "a+b")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(200).decode("utf-8", "replace").strip()
            file.close()
            raise UsageError(f"--out {path.parent}: another study is writing there ({holder})") from None
        if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            break
        file.close()  # its holder has just removed it
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        with contextlib.suppress(OSError):  # of a folder that cannot be written to any more: a lock that nobody holds is none
            path.unlink()
        file.close()
