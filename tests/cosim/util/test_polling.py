"""Waiting for descriptors, also for numbers above 1023, which select() does not support."""

import fcntl
import os
import resource
import socket
from contextlib import ExitStack, suppress

import pytest

from tests.support.paths import ROOT
from vcmvsp.cosim.util.polling import readable, writable


@pytest.mark.parametrize("least", [0, 1024])
def test_readable_and_writable(least: int) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, limits[1]), limits[1]))
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
        here, there = (stack.enter_context(each) for each in socket.socketpair())
        number = fcntl.fcntl(here, fcntl.F_DUPFD, least)
        stack.callback(os.close, number)
        assert readable([number], 0.0) == []
        there.send(b"x")
        assert readable([number, there.fileno()], 1.0) == [number]
        assert writable(number, 0.0)
        here.setblocking(False)
        with suppress(BlockingIOError):
            while here.send(bytes(1000)):
                pass
        assert not writable(number, 0.0)


def test_nothing_else_calls_select() -> None:
    tops = ("agents", "cosim", "hardware", "netsim", "physics")
    files = [path for top in tops for path in (ROOT / top).rglob("*.py") if "select.select(" in path.read_text()]
    assert files == [ROOT / "cosim/util/polling.py"]
