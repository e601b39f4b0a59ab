"""Requirements of tests on the machine, and the summary's lines on skipped tests.

A missing program can be installed: a test that needs it is skipped, the summary says what to install, and with `CI` set the
test fails. Features that the machine forbids (network namespaces, IPv6) cannot be installed, and large reference programs are
not: such a test is skipped and named everywhere.
"""

import importlib
import os
import shutil
import sys
import threading
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import Any, NoReturn

import pytest

from vcmvsp.netsim.bridge.gateways.ip import namespaces

PACKAGES = {  # where a program and its package have different names
    "ip": "iproute2",
    "ping": "iputils-ping",
    "ssh": "openssh-client",
    "ssh-keygen": "openssh-client",
    "sshd": "openssh-server",
}
NOT_ALLOWED = "this machine does not allow "
APART = "installed apart from vcmvsp's environment: "


def program(name: str) -> Path:
    """Path of a program; the test is skipped without it."""
    path = shutil.which(name) or (shutil.which(name, path="/usr/sbin") if name == "sshd" else None)  # it needs its whole path
    if path is None:
        pytest.skip(f"there is no {name}: install the Debian package {PACKAGES.get(name, name)}")
    return Path(path)


def not_allowed(feature: str) -> NoReturn:
    pytest.skip(f"{NOT_ALLOWED}{feature}")


def installed_apart(module: str) -> Any:
    """A module of a program outside of the environment; the test is skipped without it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        pytest.skip(f"{APART}{module}")


@pytest.fixture(scope="session")
def namespaces_allowed() -> None:
    if lacks := namespaces.missing():
        not_allowed(f"network namespaces with programs in them: it lacks {lacks}")


MARKERS = {
    "needs(*programs)": "skipped where one of them is missing, a failure where CI is set",
    "processes": "starts programs",
    "sockets": "opens sockets",
    "browser": "drives a browser",
    "slow": "computes for seconds",
}
OUTSIDE = {  # audit events, and the markers that allow them
    **dict.fromkeys(("subprocess.Popen", "os.fork", "os.posix_spawn"), frozenset(("processes", "browser"))),
    **dict.fromkeys(("socket.bind", "socket.connect"), frozenset(("sockets", "processes", "browser"))),
}
_markers: dict[int, set[str]] = {}  # of the running test, by its thread


def pytest_configure(config: pytest.Config) -> None:
    for name, text in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {text}")
    sys.addaudithook(_refuse)


def _refuse(event: str, arguments: object) -> None:
    """Fail a test without the marker that its work needs, so that `make quick` stays quick."""
    if event not in OUTSIDE:
        return
    markers = _markers.get(threading.get_ident())
    if markers is not None and not OUTSIDE[event] & markers:
        raise AssertionError(f"{event}{arguments}: mark this test as one of {', '.join(sorted(OUTSIDE[event]))}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    thread = threading.get_ident()
    _markers[thread] = {mark.name for mark in item.iter_markers()}
    try:
        return (yield)
    finally:
        del _markers[thread]


def pytest_runtest_setup(item: pytest.Item) -> None:
    for mark in item.iter_markers("needs"):
        for name in mark.args:
            program(name)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With `CI` set, all installable programs are required."""
    report = yield
    reason = _reason(report)
    left_out = report.skipped and not hasattr(report, "wasxfail") and not reason.startswith((NOT_ALLOWED, APART))
    if os.environ.get("CI") and left_out:
        report.outcome, report.longrepr = "failed", f"{reason} (CI is set: no test is left out for what can be installed)"
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reasons = Counter(_reason(each) for each in terminalreporter.getreports("skipped"))
    if reasons:
        terminalreporter.section("not tested")
    for reason, count in sorted(reasons.items()):
        terminalreporter.line(f"{count} {'test' if count == 1 else 'tests'}: {reason}")
    if any(not each.startswith((NOT_ALLOWED, APART)) for each in reasons):
        terminalreporter.line("As root, .ci/debian-packages installs all programs that tests need.")


def _reason(report: pytest.TestReport) -> str:
    long_text = report.longrepr
    return long_text[2].removeprefix("Skipped: ") if isinstance(long_text, tuple) else ""
