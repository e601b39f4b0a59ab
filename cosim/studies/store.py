"""Folder of a study: a table that is readable at any time, and a journal that survives a crash.

``study.toml`` holds the plan and is written first. Each finished run is appended to ``study.journal``. From time to time the
table ``study.parquet`` is replaced atomically and the journal is emptied, in less than a fiftieth of the total time for any
size of the table. A finished study has no journal.

The end of the process loses nothing. A power failure may lose runs, which are then repeated: the journal is synced to disk at
most five times a second as runs finish, and the system writes the rest within seconds. Plan and table are synced before they
replace earlier ones.
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
FIGURES = tuple(f"{name}.{kind}" for name in ("study", "study-map") for kind in ("png", "svg", "pdf"))
OUTPUTS = ("about.json", "summary.csv", "report.html", *FIGURES)
SHARE = 0.02  # largest share of time for writing the table, and for waiting for the disk
SYNC_EVERY_S = 0.2  # least time between two syncs of the journal


class JournalLine(msgspec.Struct, frozen=True):
    """A line of the journal."""

    run: str
    row: msgspec.Raw


class Answers:
    """Rows of finished runs, in memory."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.rows: dict[str, bytes] = {}  # by `Run.key`, packed

    def add(self, run: str, row: bytes) -> None:
        """Store a run's row."""
        self.rows[run] = rows.packed(row)

    def finish(self) -> pa.Table:
        """The table of all runs."""
        return rows.table_of(self.plan, self.rows)


def begun(folder: Path, *, resume: bool, force: bool) -> Plan | None:
    """The plan of the study to resume in a folder, or None for a new study.

    Raises:
        UsageError: the folder is not empty, and neither ``resume`` nor ``force`` is given.
    """
    paths = folder.iterdir() if folder.is_dir() else ()
    names = {path.name for path in paths if path.name != LOCK and path.suffix != PART}  # leftovers of a killed study
    if force or not names:
        Folder(folder, force=True)  # checks that it is writable
        return None
    if PLAN not in names:
        why = "contains no study" if resume else "is not empty; choose another folder, or add --force to overwrite"
        raise UsageError(f"--out {folder}: {why}")
    plan = Plan.read(folder / PLAN)
    if not resume:
        hint = "add --resume to continue it, --force to start again"
        raise UsageError(f"--out {folder}: already contains a study of {plan.scenario}: {hint}, or choose another folder")
    return plan


class Store(Answers):
    """Rows of finished runs, in a folder. As a context manager it locks the folder.

    Args:
        resume: continue the study in the folder, which must be the same.
        force: start a new study and discard the folder's content.
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
            for leftover in self._folder.glob(f".*{PART}"):
                shutil.rmtree(leftover, ignore_errors=True)  # leftovers of a killed study
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
        """Write the rows so far into the table and release the folder."""
        with self._stack:
            if error is not None:
                with contextlib.suppress(OSError):  # the journal still has the rows
                    self.write()

    def add(self, run: str, row: bytes) -> None:
        """Store a run's row and append it to the journal."""
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
        """Write the table of all runs and remove the journal."""
        with writing(self._folder):
            table = self.write()
            (self._folder / JOURNAL).unlink()
        return table

    def _recover(self, stored: Plan) -> None:
        """Load the stored rows from the table and the readable lines of the journal."""
        keys = {run.key for run in self.plan.runs}
        try:
            if (self._folder / TABLE).exists():
                self.rows |= rows.answers_of(read_table(self._folder / TABLE), list(stored.vary))
            lines = list(_journal(self._folder))
        except (OSError, ValueError, KeyError) as error:
            problem = " ".join(str(error).split())
            raise UsageError(f"--resume {self._folder}: its rows cannot be read: {problem}") from error
        for entry in lines:
            if rows.decode(entry.row).error is None:  # failed runs are repeated
                self.rows[entry.run] = rows.packed(bytes(entry.row))
        self.rows = {run: row for run, row in self.rows.items() if run in keys}


def so_far(folder: Path, plan: Plan) -> pa.Table:
    """The table of a study in a folder, with rows that only the journal has; the study may be unfinished.

    Raises:
        UsageError: the folder cannot be read.
    """
    try:  # the journal first: it is emptied after the table is written
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
        with contextlib.suppress(ValueError):  # an incomplete line: its run is repeated
            yield read_json(line, JournalLine)


def _opened(path: Path, mode: str) -> IO[bytes]:
    """Open a file in place, unbuffered, without following a link."""
    try:
        return open(path, mode, 0, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise UsageError(f"{path}: is a symbolic link, which studies do not follow: remove it") from error


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a folder; the system releases the lock of a process that dies."""
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
        file.close()  # removed by its last holder
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        with contextlib.suppress(OSError):  # folder no longer writable: the leftover file locks nothing
            path.unlink()
        file.close()
