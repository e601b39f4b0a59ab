"""Serial port on a pseudo-terminal whose other end does not read, or disappears."""

import os
import pty
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from tests.support.hardware.driver_runs import eventually
from vcmvsp.hardware.drivers.base import LinkLost
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line


@pytest.fixture
def ends() -> Iterator[tuple[ByteLink, int]]:
    """A line, and the descriptor of its other end, which a test may close."""
    other, ours = pty.openpty()
    tty.setraw(ours)
    line = open_line(os.ttyname(ours), 9600)
    os.close(ours)
    yield line, other
    line.close()
    with suppress(OSError):
        os.close(other)


def all_of(count: int, read: Callable[[], bytes]) -> bytes:
    """At least ``count`` bytes: Linux delivers them to the other end of a terminal later, or in pieces."""
    data = bytearray()
    eventually(lambda: data.extend(read()) or len(data) >= count)  # type: ignore[func-returns-value]
    return bytes(data)


def test_bytes_go_both_ways_without_blocking(ends: tuple[ByteLink, int]) -> None:
    line, other = ends
    assert line.read() == b""
    line.write(bytes(range(256)))
    assert all_of(256, lambda: os.read(other, 512)) == bytes(range(256))
    os.write(other, b"\0\x03\x11\x13\r\n")
    assert all_of(6, line.read) == b"\0\x03\x11\x13\r\n"


def test_writing_without_a_reader_times_out(ends: tuple[ByteLink, int]) -> None:
    line, _ = ends
    with pytest.raises(LinkLost, match="accepts no more bytes"):
        line.write(bytes(10_000_000))


def test_an_unplugged_port_raises(ends: tuple[ByteLink, int]) -> None:
    line, other = ends
    os.close(other)
    with pytest.raises(LinkLost, match="unplugged"):
        line.read()
    with pytest.raises(LinkLost, match="unplugged"):
        line.write(b"\0")
