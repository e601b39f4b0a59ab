"""Damaged scenarios, results and command lines get an answer: one message, soon, and nothing written elsewhere."""

import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz import forked, mutations
from tests.support.paths import ROOT

pytestmark = pytest.mark.processes


@pytest.mark.timeout(1800)  # of processor time it takes a small part of that
def test_a_few_cases_in_every_way() -> None:
    """More of them: ``python -m tests.fuzz --cases 10000 --seed 1``."""
    command = [sys.executable, "-m", "tests.fuzz", "--cases", "60"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_case_depends_on_its_seed_and_number_alone(tmp_path: Path) -> None:
    def scenario(number: int) -> bytes:
        mutations.changed_scenario(random.Random(number), tmp_path, tmp_path)
        return (tmp_path / "s.toml").read_bytes()

    first = [scenario(number) for number in range(200)]
    assert [scenario(number) for number in reversed(range(200))] == first[::-1]


def _refuse() -> None:
    sys.stderr.write("give another one")
    raise SystemExit(2)


def _burn() -> None:
    while time.process_time() < 60.0:
        pass


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (_refuse, ""),
        (lambda: Path("out").write_text("x"), ""),
        (lambda: sys.exit(1), "it fails without a word"),
        (lambda: sys.exit(4), "exit code 4"),
        (lambda: next(iter(())), "a traceback"),
        (_burn, "s of processor time"),
        (lambda: len(b"x" * 2**27), "MiB"),
        (lambda: Path("beside").write_text("x"), "it wrote outside --out: beside"),
        (lambda: Path("../../elsewhere").write_text("x"), "it wrote outside the folder: open"),
    ],
)
def test_what_breaks_a_law_is_found(
    command: Callable[[], object], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "MEMORY_BYTES", 2**26)
    if command is _burn:
        monkeypatch.setattr(forked, "CPU_S", 0)  # the system ends it 1 s later
    monkeypatch.setattr(forked, "main", lambda words: command())
    (tmp_path / "here" / "case").mkdir(parents=True)
    found = forked.problems([], tmp_path / "here" / "case")
    assert problem in "\n".join(found)
    assert bool(found) == bool(problem)
