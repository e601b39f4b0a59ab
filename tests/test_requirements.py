"""Tests that the machine cannot run are reported with what to install, and fail with CI set."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.processes

TESTS = """
import subprocess

import pytest
from tests.support import requirements

@pytest.mark.needs("no-such-program")
def test_marked(): pass

@pytest.mark.needs("sshd")
def test_package(): pass

@pytest.fixture
def program(): return requirements.program("no-such-program")

def test_fixture(program): pass

def test_right(): requirements.not_allowed("IPv6")

def test_apart(): requirements.installed_apart("no_such_peer")

def test_library(): pytest.importorskip("no_such_library")

@pytest.mark.xfail
def test_expected(): assert False

def test_whole(): pass

def test_unmarked():
    with pytest.raises(AssertionError, match="mark this test as one of browser, processes"):
        subprocess.run(["true"])

@pytest.mark.processes
def test_a_marked_one():
    with pytest.raises(FileNotFoundError):
        subprocess.run(["no-such-program"])
"""


@pytest.mark.parametrize(("ci", "workers"), [("", "2"), ("true", "0")])
def test_skipped_tests_are_named_and_fail_with_ci_set(ci: str, workers: str, tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(
        'import shutil\npytest_plugins = ["tests.support.requirements"]\nshutil.which = lambda name, path=None: None\n'
    )
    (tmp_path / "test_some.py").write_text(TESTS)
    environment = {**os.environ, "CI": ci, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "-n", workers, "-p", "no:cacheprovider", "--rootdir", ".", "test_some.py"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=500, cwd=tmp_path, env=environment)
    counts = set(done.stdout.strip().rpartition("\n")[2].partition(" in ")[0].split(", "))
    assert counts == {"3 passed", "1 xfailed", *(("2 skipped", "1 failed", "3 errors") if ci else ("6 skipped",))}
    assert done.returncode == bool(ci)
    summary = done.stdout.partition(" not tested ")[2]
    assert "1 test: this machine does not allow IPv6\n" in summary
    assert "1 test: installed apart from vcmvsp's environment: no_such_peer\n" in summary
    assert ("2 tests: there is no no-such-program: install the Debian package no-such-program\n" in summary) == (not ci)
    assert ("As root, .ci/debian-packages installs" in summary) == (not ci)
    assert "there is no sshd: install the Debian package openssh-server" in done.stdout
    assert "could not import 'no_such_library'" in done.stdout
