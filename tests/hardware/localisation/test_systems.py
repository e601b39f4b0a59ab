"""Positioning sources over sockets, pseudo-terminals and Zenoh sessions: readings, refusals, notices."""

import contextlib
import itertools
import json
import math
import os
import pty
import socket
import time
import tty
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from tests.hardware.localisation.test_readers import GGA, HEIGHT, LAT, LON
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.fusion import Fusion
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.cosim.types import Fix
from vcmvsp.hardware.drivers.base import HandshakeError, PortError
from vcmvsp.hardware.localisation import dwm1001, port_source, pose_topic, source, ubisense
from vcmvsp.hardware.localisation.dwm1001 import Dwm1001
from vcmvsp.hardware.localisation.nmea import Nmea
from vcmvsp.hardware.localisation.pose_topic import ExternalPose
from vcmvsp.hardware.localisation.source import DatagramReader, Localisation, Located, WorldTransform
from vcmvsp.hardware.localisation.ubisense import Ubisense

pytestmark = pytest.mark.sockets

DEADLINE_S = 20.0  # generous: some ms without load
HERE: dict[str, Any] = {"latitude_deg": LAT, "longitude_deg": LON, "height_m": HEIGHT}


def wait(poll: Callable[[], Any]) -> Any:
    """First true result of a poll."""
    last = time.monotonic() + DEADLINE_S
    while time.monotonic() < last:
        if found := poll():
            return found
        time.sleep(0.005)
    raise AssertionError("nothing came")


def fixes(source: Localisation) -> list[Fix]:
    return source.read(time.monotonic_ns())


def causes(source: Localisation, word: str) -> Callable[[], list[str]]:
    """Poll for notices that contain a word."""

    def look() -> list[str]:
        source.read(time.monotonic_ns())
        return [each.cause for each in source.notices() if word in each.cause]

    return look


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "PATIENCE_S", 0.2)
    monkeypatch.setattr(source, "CENSUS_S", 0.2)


@contextlib.contextmanager
def listening(source: Any) -> Iterator[Any]:
    source.open()
    try:
        yield source
    finally:
        source.close()
        source.close()


@contextlib.contextmanager
def sending(**parameters: Any) -> Iterator[tuple[Ubisense, Callable[..., None]]]:
    """An open source at a free port, and a function that sends datagrams to it."""
    with (
        listening(Ubisense(listen="udp://127.0.0.1:0", **parameters)) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        out.connect(("127.0.0.1", int(source.device.rpartition(":")[2])))

        def send(
            data: bytes = b"", *, tag: str = "11", at: Any = (1.0, 2.0, 0.5), source_ns: int = 0, sigma_m: float | None = None
        ) -> None:
            out.send(data or ubisense.encode(Located(tag=tag, position=at, source_ns=source_ns, sigma_m=sigma_m)))

        yield source, send


class Terminal:
    """A pseudo-terminal behind a link, for unplugging and replugging."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.plug()

    def plug(self) -> None:
        self.here, self._there = pty.openpty()
        tty.setraw(self._there)
        os.set_blocking(self.here, False)
        self.link.symlink_to(os.ttyname(self._there))

    def unplug(self) -> None:
        self.link.unlink()
        os.close(self.here)
        os.close(self._there)

    def read(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self.here, 4096)
        return b""


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    terminal = Terminal(tmp_path / "tty")
    yield terminal
    terminal.unplug()


def test_ubisense_positions_are_turned_and_moved_into_the_world() -> None:
    with sending(tag="0x11", offset=(10.0, 20.0, 1.0), turn_rad=0.5 * math.pi, sigma_m=0.3) as (source, send):
        assert isinstance(source, Localisation)
        send(tag="22", at=(7.0, 7.0, 7.0))
        send()
        before = time.monotonic_ns()
        (fix,) = wait(lambda: fixes(source))
        assert fix.position == pytest.approx((8.0, 21.0, 1.5))
        assert (fix.sigma_m, fix.yaw) == (0.3, None)
        assert abs(fix.time_ns - (before - 0.1 * SECOND_NS)) < DEADLINE_S * SECOND_NS
        assert fixes(source) == []
        send(sigma_m=0.05)
        (fix,) = wait(lambda: fixes(source))
        assert fix.sigma_m == pytest.approx(0.05)
        assert [each.cause for each in source.notices()] == ["positions of tag 0000000000000011 come"]


def test_the_systems_clock_gives_the_times_between_positions() -> None:
    """Positions measured 40 ms apart that arrive together."""
    with sending(tag="11", latency_s=0.05) as (source, send):
        for tick in range(3):
            send(source_ns=10**15 + tick * 40_000_000)
        received: list[Fix] = []

        def all_three() -> bool:
            received.extend(fixes(source))
            return len(received) == 3

        wait(all_three)
        apart = [b.time_ns - a.time_ns for a, b in itertools.pairwise(received)]
        assert all(0 <= each <= 40_000_000 for each in apart)
        assert received[-1].time_ns <= time.monotonic_ns() - 50_000_000


@pytest.mark.usefixtures("impatient")
def test_several_unnamed_tags_are_an_error_with_a_list() -> None:
    with sending() as (source, send):

        def look() -> str:
            send(tag="A1")
            send(tag="B2")
            try:
                assert fixes(source) == []  # tag still undetermined
            except HandshakeError as error:
                return str(error)
            return ""

        error = wait(look)
        assert "2 tags" in error
        assert "00000000000000A1, 00000000000000B2" in error
        assert "tag = " in error


@pytest.mark.usefixtures("impatient")
def test_the_only_tag_needs_no_name() -> None:
    with sending() as (source, send):
        assert wait(lambda: send() or fixes(source))[0].position == pytest.approx((1.0, 2.0, 0.5))


def test_a_used_port_and_wrong_addresses_give_advice() -> None:
    with listening(Ubisense(listen="udp://127.0.0.1:0")) as first, pytest.raises(PortError, match=r"in use.*close the other"):
        Ubisense(listen=first.device).open()
    with pytest.raises(PortError, match=r"no interface with the address 192\.0\.2\.1.*0\.0\.0\.0"):
        Ubisense(listen="udp://192.0.2.1:5010").open()
    with pytest.raises(PortError, match="is unknown"):
        Ubisense(listen="udp://no.such.host.invalid:5010").open()
    with pytest.raises(PortError, match="no such port"):
        Dwm1001(port="/dev/ttyNONE").open()
    with pytest.raises(PortError, match="not a serial port"):
        Nmea(port="/dev/null", **HERE).open()


@pytest.mark.parametrize(
    "listen", ["127.0.0.1:5010", "udp://127.0.0.1", "tcp://127.0.0.1:1", "udp://:5010", "udp://a:99999", ""]
)
def test_wrong_addresses_are_refused_with_the_scenario(listen: str) -> None:
    with pytest.raises(ScenarioError, match=r"udp://0\.0\.0\.0:5010") as caught:
        call(Ubisense, {"listen": listen}, key="vehicle.car1.localisation")
    assert caught.value.key == "vehicle.car1.localisation.listen"


@pytest.mark.parametrize(
    ("kind", "table", "error_text"),
    [
        (Ubisense, {"tag": "car1"}, "hexadecimal"),
        (Ubisense, {"tag": "1" * 17}, "hexadecimal"),
        (Ubisense, {"tag": "-1"}, "hexadecimal"),
        (Ubisense, {"sigma_m": 0.0}, "> 0|above 0|greater"),
        (Ubisense, {"offset": [1.0, 2.0]}, "3"),
        (Ubisense, {"offset": [1.0, math.nan, 0.0]}, "finite"),
        (Dwm1001, {}, "is missing"),
        (Nmea, {"port": "/dev/ttyUSB0", "latitude_deg": 91.0, "longitude_deg": 0.0}, "90"),
        (ExternalPose, {"key": "a//b"}, "mocap/car1"),
        (ExternalPose, {"key": "a", "mode": "peer"}, "connect"),
    ],
)
def test_wrong_parameters_are_named(kind: Any, table: dict[str, Any], error_text: str) -> None:
    with pytest.raises(ScenarioError, match=error_text):
        call(kind, table, key="localisation")


@pytest.mark.usefixtures("impatient")
def test_silence_has_a_cause_and_an_end_notice() -> None:
    with sending(tag="11") as (source, send):
        assert "location engine" in wait(causes(source, "nothing comes"))[0]
        send(b"hello")
        assert wait(causes(source, "are not Ubisense's"))
        send(tag="22")
        assert "0000000000000022" in wait(causes(source, "received tags"))[0]
        send(at=None)
        assert wait(causes(source, "reports none"))
        send(at=(1e6, 0.0, 0.0))
        assert wait(causes(source, "10 km"))
        send()
        assert wait(causes(source, "come"))
        assert len(fixes(source)) <= 1
        assert wait(causes(source, "nothing comes"))


@pytest.mark.usefixtures("impatient")
def test_a_clock_jump_is_reported() -> None:
    with sending(tag="11") as (source, send):
        for stamp in (1000, 1001, 1002, 9_001_000, 9_001_001, 9_001_002):
            send(source_ns=stamp * 1_000_000)
        assert wait(causes(source, "clock"))


def test_a_dwm1001_is_woken_unplugged_and_woken_again(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dwm1001, "Waker", lambda patient=dwm1001.Waker: patient(0.1))
    monkeypatch.setattr(port_source, "RETRY_S", 0.05)
    source, tag = Dwm1001(port=str(terminal.link), offset=(1.0, 0.0, 0.0)), dwm1001.Tag()

    def turn() -> list[Fix]:
        answer = tag.receive(terminal.read()) + tag.say(Located(position=(1.0, 2.0, 0.5), quality=0.9))
        os.write(terminal.here, answer)
        time.sleep(0.02)
        return fixes(source)

    with listening(source):
        assert wait(turn)[0].position == pytest.approx((2.0, 2.0, 0.5))
        waker = source._waker
        terminal.unplug()
        assert "plug it in" in wait(causes(source, "disappeared"))[0]
        terminal.plug()
        tag = dwm1001.Tag()
        assert wait(turn)[0].position == pytest.approx((2.0, 2.0, 0.5))
        assert wait(causes(source, "positions come"))
        assert source._waker is not waker  # a module loses its state without power, so a new waker starts


@pytest.mark.usefixtures("impatient")
def test_a_receiver_gives_tangent_plane_positions_and_a_baud_rate_hint(terminal: Terminal) -> None:
    with listening(Nmea(port=str(terminal.link), **HERE)) as source:
        os.write(terminal.here, bytes(range(128, 256)) + b"\n")
        assert wait(causes(source, "check the baud rate"))
        os.write(terminal.here, GGA[:20])
        time.sleep(0.05)
        os.write(terminal.here, GGA[20:])
        (fix,) = wait(lambda: fixes(source))
        assert fix.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
        assert fix.sigma_m == pytest.approx(0.9 * 4.0 / math.sqrt(2.0))


@pytest.mark.usefixtures("impatient")
def test_a_replugged_silent_port_is_reported(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_source, "RETRY_S", 0.05)
    with listening(Nmea(port=str(terminal.link), **HERE)) as source:
        terminal.unplug()
        assert wait(causes(source, "disappeared"))
        terminal.plug()
        assert wait(causes(source, "nothing comes"))


def test_a_source_can_be_opened_again(terminal: Terminal) -> None:
    source = Nmea(port=str(terminal.link), **HERE)
    source.close()  # not opened before
    for _ in range(2):
        with listening(source):
            os.write(terminal.here, GGA)
            assert wait(lambda: fixes(source))
    with listening(source), pytest.raises(PortError, match="in use"):
        Nmea(port=str(terminal.link), **HERE).open()


def test_a_reader_failure_is_no_silence(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Nmea(port=str(terminal.link), **HERE)
    monkeypatch.setattr(source._reader, "feed", lambda chunk: 1 / 0)
    with listening(source):
        os.write(terminal.here, GGA)

        def look() -> str:
            try:
                fixes(source)
            except Exception as error:
                return str(error)
            return ""

        assert "ZeroDivisionError" in wait(look)


@contextlib.contextmanager
def bridge(mode: str, endpoint: str) -> Iterator[Callable[[str, Any], None]]:
    """Publisher of poses, as a router or as a client."""
    where = {"listen": {"endpoints": [endpoint]}} if mode == "router" else {"connect": {"endpoints": [endpoint]}}
    with opened({"mode": mode, **where}, {}, "no bridge") as session:

        def say(key: str, value: Any) -> None:
            session.put(key, value if isinstance(value, bytes) else json.dumps(value))

        yield say


@pytest.mark.parametrize("mode", ["connect", "listen"])
def test_poses_come_over_zenoh(mode: Any, port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    source = ExternalPose(key="mocap/car1", endpoint=endpoint, mode=mode, turn_rad=1.0, offset=(0.0, 0.0, 2.0), sigma_rad=0.05)
    assert isinstance(source, Localisation)
    with contextlib.ExitStack() as stack:
        if mode == "listen":
            stack.enter_context(listening(source))
            say = stack.enter_context(bridge("client", endpoint))
        else:
            say = stack.enter_context(bridge("router", endpoint))
            stack.enter_context(listening(source))
        for wrong in (b"\xff", b"{}", b"[1, 2]", b'{"x": NaN, "y": 0}', {"x": 1e5, "y": 0}, b" " * 5000, {"x": "1", "y": 0}):
            say("mocap/car1", wrong)
        say("mocap/car2", {"x": 5.0, "y": 5.0})
        full = {"t": time.time(), "x": 1.0, "y": 0.0, "z": 0.25, "yaw": 3.0, "sigma": 0.002, "frame": "lab"}
        (fix,) = wait(lambda: say("mocap/car1", full) or fixes(source))[:1]
        assert fix.position == pytest.approx((math.cos(1.0), math.sin(1.0), 2.25))
        assert fix.yaw == pytest.approx(4.0 - math.tau)
        assert (fix.sigma_m, fix.sigma_rad) == (0.002, 0.05)
        assert [each.cause for each in source.notices()] == ["positions come"]


def test_no_peer_and_no_address_to_listen_on(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_topic, "_CONNECT_MS", 100)
    with pytest.raises(PortError, match="start the router"):
        ExternalPose(key="a", endpoint=f"tcp/127.0.0.1:{port}").open()
    with socket.create_server(("127.0.0.1", port)), pytest.raises(PortError, match="free port"):
        ExternalPose(key="a", endpoint=f"tcp/127.0.0.1:{port}", mode="listen").open()


def test_a_session_without_subscriber_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoSubscriber:
        closed = False

        def declare_subscriber(self, *_: object) -> None:
            raise zenoh.ZError("no")

        def close(self) -> None:
            self.closed = True

    session = NoSubscriber()
    monkeypatch.setattr(pose_topic, "opened", lambda *_: session)
    with pytest.raises(PortError, match="cannot receive"):
        ExternalPose(key="a").open()
    assert session.closed


@pytest.mark.usefixtures("impatient")
def test_a_returning_bridge_is_received_again(port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    with contextlib.ExitStack() as stack:
        with bridge("router", endpoint) as say:
            source = stack.enter_context(listening(ExternalPose(key="a", endpoint=endpoint)))
            wait(lambda: say("a", {"x": 0.0, "y": 0.0}) or fixes(source))
            source.notices()  # drops an earlier notice of silence
        assert wait(causes(source, "check that a bridge publishes"))
        with bridge("router", endpoint) as say:
            wait(lambda: say("a", {"x": 0.0, "y": 0.0}) or fixes(source))
            assert wait(causes(source, "positions come"))


numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(
    position=st.none() | st.tuples(numbers, numbers, numbers),
    sigma=st.none() | numbers,
    yaw=st.none() | st.floats(-10.0, 10.0),
    sigma_rad=numbers,
    source_ns=st.none() | st.integers(-(2**63), 2**64),
)
def test_any_message_gives_finite_near_readings_not_from_the_future(
    position: Any, sigma: Any, yaw: Any, sigma_rad: float, source_ns: int | None
) -> None:
    placing = WorldTransform(sigma_m=0.1, latency_s=0.1, offset=(1.0, 2.0, 3.0), turn_rad=0.3)
    for arrived in (10**9, 2 * 10**9):
        posed = Located(position=position, sigma_m=sigma, yaw=yaw, sigma_rad=sigma_rad, source_ns=source_ns)
        fix = placing.place(posed, arrived)
        if fix is not None:
            assert math.hypot(*fix.position) <= 10_000.0
            assert 1e-3 <= fix.sigma_m <= 10_000.0
            assert arrived - 10**10 <= fix.time_ns <= arrived - 10**8
            assert (fix.yaw is None) == (yaw is None or not 0.0 < sigma_rad <= math.pi)
            assert fix.yaw is None or fix.sigma_rad >= 1e-3
            assert fix.yaw is None or fix.yaw == pytest.approx(math.remainder(yaw + 0.3, math.tau), abs=1e-9)
        elif position is not None:
            assert placing.rejected["old"] or placing.rejected["unknown"] or not math.hypot(*position) <= 9_990.0


@pytest.mark.parametrize(
    ("data", "position", "yaw"),
    [
        (b'{"x": 1, "y": 2, "yaw": 0.5}', True, (0.5, 0.02)),
        (b'{"x": 1, "y": 2, "yaw": 0.5, "sigma": 1e200}', False, None),
        (b'{"x": 1, "y": 2, "yaw": 0.5, "sigma": 0}', True, (0.5, 0.02)),
        (b'{"x": 1, "y": 2, "yaw": 0.5, "sigma_yaw": 0}', True, (None, 0.0)),
        (b'{"x": 1, "y": 2, "yaw": 0.5, "sigma_yaw": 1e-200}', True, (0.5, 0.001)),
        (b'{"x": 1, "y": 2, "yaw": 0.5, "sigma_yaw": 4}', True, (None, 0.0)),
        (b'{"x": 1, "y": 2, "t": 1e299}', True, (None, 0.0)),
        (b'{"x": 1, "y": 2, "a": ' + b"[" * 30_000 + b"]" * 30_000 + b"}", False, None),
    ],
)
def test_no_message_raises_errors(data: bytes, position: bool, yaw: Any) -> None:
    reader, placing, fusion = (
        DatagramReader(partial(pose_topic.decode, 0.02)),
        WorldTransform(sigma_m=0.1, latency_s=0.0),
        Fusion(start=(0.0, 0.0, 0.0)),
    )
    fixes = [placing.place(each, SECOND_NS) for each in reader.feed(data)]
    known = [each for each in fixes if each is not None]
    assert bool(known) == position
    for fix in known:
        assert (fix.yaw, fix.sigma_rad) == yaw
        fusion.fix(fix.time_ns, fix.position[0], fix.position[1], fix.sigma_m)
    assert bool(known) or reader.invalid + placing.rejected["unknown"] == 1


def test_a_stopped_clock_is_reported_without_readings() -> None:
    placing = WorldTransform(sigma_m=0.1, latency_s=0.1)
    times = [placing.place(Located(position=(0.0, 0.0, 0.0), source_ns=7), tick * SECOND_NS) for tick in range(60)]
    assert [each is None for each in times] == [False] * 10 + [True] * 50
    assert placing.rejected["old"] == 50


def test_memory_for_tags_is_limited() -> None:
    placing = WorldTransform(sigma_m=0.1, latency_s=0.1)
    for number in range(1000):
        placing.place(Located(tag=str(number), position=(0.0, 0.0, 0.0), source_ns=number + 1), number)
    assert len(placing.tags) == len(placing._clocks) == 64


def test_the_sessions_that_zenoh_opens_are_closed() -> None:
    """An open session would keep the process from ending."""
    source = ExternalPose(key="a", endpoint="tcp/127.0.0.1:0", mode="listen")
    with listening(source):
        session = source._session
        assert session is not None
        assert not session.is_closed()
    assert session.is_closed()
    assert isinstance(session, zenoh.Session)


@pytest.mark.parametrize("host", ["0.0.0.0", "0", "[::]", "[::0]"])
def test_all_interfaces_need_an_option(host: str) -> None:
    with pytest.raises(ValueError, match=r"admits anyone .* add insecure = true"):
        Ubisense(listen=f"udp://{host}:5010")
    Ubisense(listen=f"udp://{host}:5010", insecure=True)
