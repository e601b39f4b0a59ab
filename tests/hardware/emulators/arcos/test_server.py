"""Emulated robot at a port, and its line. Only port functions run in real time."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import serial  # type: ignore[import-untyped]
from hypothesis import given
from hypothesis import strategies as st

from tests.support.hardware.driver_runs import PATIENCE_S, eventually, open_resources
from vcmvsp.cosim.rng import stream
from vcmvsp.hardware.drivers.arcos.protocol import Command, PacketReader, command, frame, is_sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import ArcosServer, Faults, Wire, serve_pty, serve_tcp

pytestmark = pytest.mark.sockets

AMIGO = ROBOTS["amigo"]
MS = 1_000_000
BOTH = pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
Serve = Callable[..., ArcosServer]


class Port:
    """Client end of a port."""

    def __init__(self, url: str) -> None:
        self.serial, self.reader = serial.serial_for_url(url, timeout=0.02), PacketReader()

    def __enter__(self) -> "Port":
        return self

    def __exit__(self, *_: object) -> None:
        if socket := getattr(self.serial, "_socket", None):
            socket.close()  # pyserial leaves it open if the other end closed first
        self.serial.close()

    def say(self, number: int, argument: int | None = None) -> None:
        self.serial.write(command(number, argument))

    def hear(self, until: Callable[[list[bytes]], bool]) -> list[bytes]:
        """Packets, read until ``until`` accepts them."""
        packets: list[bytes] = []
        end = time.monotonic() + PATIENCE_S
        while not until(packets):
            assert time.monotonic() < end, f"only {len(packets)} packets came in time"
            packets += self.reader.feed(self.serial.read(256))
        return packets

    def connect(self) -> None:
        for number in range(3):
            self.say(number)
            assert self.hear(bool)[0][0] == number
        self.say(Command.OPEN, 1)


# At a port


@BOTH
def test_a_device_continues_when_served_again(serve: Serve) -> None:
    device = Device(AMIGO, old_session=True)
    device.advance(10**11)
    for _ in range(2):
        with serve(device) as served, Port(served.url) as port:
            port.hear(lambda packets: len(packets) >= 3)
        assert 10**11 < device.now_ns < 1.1 * 10**11


@BOTH
def test_without_close_the_old_session_remains(serve: Serve) -> None:
    with serve(Device(AMIGO)) as served:
        with Port(served.url) as port:
            port.connect()
        with Port(served.url) as port:
            port.say(0)
            assert is_sip(port.hear(bool)[0])


@BOTH
def test_unplugging_ends_the_stream(serve: Serve) -> None:
    with serve(Device(AMIGO)) as served, Port(served.url) as port:
        port.connect()
        served.close()
        with pytest.raises(serial.SerialException):
            port.hear(lambda _: False)
        served.close()  # a second call has no effect


@BOTH
def test_nothing_remains(serve: Serve) -> None:
    before = open_resources()
    for _ in range(3):
        with serve(Device(AMIGO)) as served, Port(served.url) as port:
            port.connect()
    eventually(lambda: open_resources() <= before)


def test_a_link_leads_to_the_terminal_and_goes_with_it(tmp_path: Path) -> None:
    link = tmp_path / "robot"
    for _ in range(2):  # replugged at the same place
        with serve_pty(Device(AMIGO), link=link) as served, Port(served.url) as port:
            assert served.url == str(link)
            port.connect()
        assert not link.is_symlink()
    link.touch()
    with pytest.raises(FileExistsError):
        serve_pty(Device(AMIGO), link=link)


def test_a_link_that_a_killed_emulator_left_is_replaced_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "robot"
    link.symlink_to("/dev/pts/99999999")  # of a terminal that no longer exists
    with serve_pty(Device(AMIGO), link=link):
        assert link.exists()
    ends = os.openpty()
    name = os.ttyname(ends[1])
    link.symlink_to(name)  # a terminal in use elsewhere
    with pytest.raises(FileExistsError):
        serve_pty(Device(AMIGO), link=link)
    elsewhere = tmp_path / "other"
    elsewhere.symlink_to(tmp_path / "nothing")  # not a terminal: not removed
    with pytest.raises(FileExistsError):
        serve_pty(Device(AMIGO), link=elsewhere)
    monkeypatch.setattr("pty.openpty", lambda: ends)  # the number is now our own terminal's
    with serve_pty(Device(AMIGO), link=link):
        assert str(link.readlink()) == name


def test_a_port_in_use_is_refused() -> None:
    with serve_tcp(Device(AMIGO)) as served, pytest.raises(OSError, match="in use"):
        serve_tcp(Device(AMIGO), port=int(served.url.rpartition(":")[2]))


def test_an_inner_error_is_raised_on_close() -> None:
    served = serve_pty(Device(AMIGO, old_session=True))
    with served.lock:
        served.device.battery_v = float("nan")  # cannot be encoded in a packet
    with Port(served.url):
        served._thread.join(PATIENCE_S)
    with pytest.raises(ValueError, match="NaN"):
        served.close()


@BOTH
def test_a_noisy_line_gives_bad_checksums(serve: Serve) -> None:
    def has_bad_checksums(packets: list[bytes]) -> bool:
        return len(packets) >= 3 and served.up.dropped + served.up.flipped > 0 and port.reader.dropped_bytes > 0

    faults = Faults(drop=0.01, flip=0.01, split=0.05, seed=4)
    with serve(Device(AMIGO, old_session=True), faults=faults) as served, Port(served.url) as port:
        port.hear(has_bad_checksums)


# The line alone


def wire(baud: int | None = None, seed: int = 0, **faults: float) -> Wire:
    return Wire(Faults(**faults, seed=seed), stream(seed, "line"), baud)  # type: ignore[arg-type]


def test_ten_bits_a_byte() -> None:
    """59 bytes at 9600 baud take 61.46 ms; bytes sent meanwhile wait."""
    line = wire(baud=9600)
    line.push(bytes(range(59)), 0)
    line.push(b"\xff", 10 * MS)
    assert line.pop(61 * MS) == bytes(range(58))
    assert line.pop(round(59 / 960 * 1e9)) == b"\x3a"
    assert line.due_ns == pytest.approx(60 / 960 * 1e9, abs=60)
    assert line.pop(63 * MS) == b"\xff"
    assert line.due_ns is None


@given(st.binary(max_size=300), st.integers(0, 300))
def test_a_perfect_line_keeps_bytes(data: bytes, cut: int) -> None:
    line = wire()
    line.push(data[:cut], 5)
    line.push(data[cut:], 5)
    assert line.pop(5) == data


def test_rates_of_faults() -> None:
    n = 100_000
    line = wire(drop=0.02, flip=0.03)
    line.push(bytes(n), 0)
    got = np.frombuffer(line.pop(0), np.uint8)
    assert len(got) == n - line.dropped
    assert np.count_nonzero(got) == line.flipped
    for count, p in ((line.dropped, 0.02), (line.flipped, 0.03 * 0.98)):
        assert abs(count - n * p) < 4 * np.sqrt(n * p * (1 - p))
    assert set(np.unique(got).tolist()) == {0, 1, 2, 4, 8, 16, 32, 64, 128}


def test_gaps_delay_and_lose_nothing() -> None:
    line = wire(split=0.2)
    line.push(bytes(range(100)), 0)
    pieces = []
    while (due := line.due_ns) is not None:
        assert due % (30 * MS) == 0
        pieces.append(line.pop(due))
    assert b"".join(pieces) == bytes(range(100))
    assert 10 < len(pieces) < 32


@given(st.lists(st.binary(min_size=1, max_size=20), max_size=20), st.integers(0, 2**32))
def test_faults_depend_on_the_seed_and_not_on_the_split(parts: list[bytes], seed: int) -> None:
    cut, whole = (wire(seed=seed, drop=0.1, flip=0.1) for _ in range(2))
    for each in parts:
        cut.push(each, 0)
    whole.push(b"".join(parts), 0)
    assert cut.pop(0) == whole.pop(0)


def test_repeated_commands_drive_over_a_noisy_line() -> None:
    """2 % of bytes lost and 2 % changed in each direction: 0.2 m/s for 10 s, commanded twice a second, in simulated time."""
    device = Device(AMIGO, old_session=True)
    down, up = wire(baud=9600, seed=1, drop=0.02, flip=0.02), wire(baud=9600, seed=2, drop=0.02, flip=0.02)
    reader, packets = PacketReader(), 0
    for ms in range(0, 10_000, 5):
        if ms % 500 == 0:
            down.push(command(Command.ENABLE, 1) + command(Command.VEL, 200), ms * MS)
        up.push(device.receive(down.pop(ms * MS), ms * MS), ms * MS)
        packets += sum(is_sip(each) for each in reader.feed(up.pop(ms * MS)))
    assert 1.5 < device.odometry[0] < 2.0
    assert 10 < packets < 50  # 0.96 to the power of 39 to 42 bytes is 0.19
    assert device.reader.bad_checksums > 0


def test_a_full_packet_of_16_sonars_fits_into_its_tenth_of_a_second_at_9600_baud() -> None:
    device = Device(ROBOTS["p2dx"], old_session=True, ping_ms=10)
    sent = device.advance(100 * MS)
    assert len(sent) == 83 == len(frame(bytes(78)))
    line = wire(baud=9600)
    line.push(sent, 0)
    assert line.pop(100 * MS) == sent
