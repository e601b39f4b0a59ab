"""Programs in the time of the run: exact to the nanosecond, in order, and independent of their computing time."""

import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.support.netsim.socket_programs import Play, idle, run_programs, scenario
from vcmvsp.cosim.sockets import RunOver, Socket

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

MS = 1_000_000
LOSSY = {"preset": "wifi-b-1", "loss": {"probability": 0.3}, "delay": {"seconds": 0.01, "jitter_s": 0.003}}


def ping(log: list[Any], slow_s: float) -> Play:
    def play(end: Socket) -> None:
        for number in range(10**6):
            end.sendto(b"%d" % number, "b")
            time.sleep(slow_s * (number % 3))
            try:
                log.append((end.time_ns(), *end.recvfrom(timeout=0.05)))
                end.sleep(0.001)
            except TimeoutError:
                log.append((end.time_ns(), "lost"))

    return play


def pong(log: list[Any], slow_s: float) -> Play:
    def play(end: Socket) -> None:
        for data, sender in end:
            log.append((end.time_ns(), data, sender))
            time.sleep(slow_s * (len(log) % 2))
            end.sendto(data + b"!")

    return play


def test_the_same_traffic_however_long_programs_take_and_at_any_pace(tmp_path: Path) -> None:
    runs = []
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as load:
        try:
            for slow_s, realtime in ((0.0, None), (0.01, None), (0.0, 4.0)):
                if realtime:
                    load.kill()
                log, other = list[Any](), list[Any]()
                plays = {"a": ping(log, slow_s), "b": pong(other, slow_s)}
                result = run_programs(scenario(tmp_path, "a", "b", radio=LOSSY), plays, realtime=realtime, mcap=False)
                runs.append((result.metrics, log, other))
        finally:
            load.kill()
    assert runs[0] == runs[1] == runs[2]
    times, lost = [entry[0] for entry in runs[0][1]], [entry[1] for entry in runs[0][1]].count("lost")
    assert times == sorted(times)
    assert 5 < lost < len(times) - 5


def test_time_advances_exactly_as_a_program_requests(tmp_path: Path) -> None:
    times_ns = list[int]()

    def play(end: Socket) -> None:
        for seconds in (0.1, 0.1, 0.1, 1e-9, 0.0, 1 / 3):
            end.sleep(seconds)
            times_ns.append(end.time_ns())
        for timeout in (0.05, 0.0, 1e-9):
            with pytest.raises(TimeoutError):
                end.recvfrom(timeout=timeout)
            times_ns.append(end.time_ns())
        assert end.time() == times_ns[-1] / 1e9

    run_programs(scenario(tmp_path, "a"), {"a": play}, mcap=False)
    waits_ns = [after - before for before, after in pairwise([0, *times_ns])]
    assert waits_ns == [100 * MS, 100 * MS, 100 * MS, 1, 0, 333_333_333, 50 * MS, 0, 1]


@pytest.mark.parametrize(("timeout", "hears"), [(0.02, True), (0.019999999, False), (0.020000001, True), (None, True)])
def test_an_arrival_at_the_nanosecond_of_the_timeout_is_in_time(tmp_path: Path, timeout: float | None, hears: bool) -> None:
    results: list[Any] = []

    def listen(end: Socket) -> None:
        try:
            results.append(end.recvfrom(timeout))
        except TimeoutError:
            results.append("nothing")
        results.append(end.time_ns())

    def tell(end: Socket) -> None:
        assert end.sendto(bytearray(b"now"), "a") == 3

    radio = {"delay": {"seconds": 0.02}}
    result = run_programs(scenario(tmp_path, "a", "b", radio=radio), {"a": listen, "b": tell}, mcap=False)
    assert results == ([(b"now", "b"), 20 * MS] if hears else ["nothing", 20 * MS - 1])
    assert result.metrics["radio"]["frames"] == 1


def test_a_message_enters_the_channel_at_the_instant_of_its_program(tmp_path: Path) -> None:
    def play(end: Socket) -> None:
        for data in (b"", b"x", b"y" * 65_535):
            end.sleep(0.123456789)
            end.sendto(memoryview(data))

    received: list[Any] = []

    def listen(end: Socket) -> None:
        received.extend((len(data), sender) for data, sender in end)

    events = list[Any]()
    run_programs(scenario(tmp_path, "a", "b"), {"a": play, "b": listen}, mcap=False, observe=events.append)
    sent = [(each.time_ns, each.value.size_bytes) for each in events if each.key == "a/send"]
    assert sent == [(123_456_789, 0), (246_913_578, 1), (370_370_367, 65_535)]
    assert received == [(0, "a"), (1, "a"), (65_535, "a")]


def test_at_one_instant_programs_go_on_one_after_another_in_the_order_of_their_names(tmp_path: Path) -> None:
    log: list[str] = []

    def play(end: Socket) -> None:
        for _ in range(5):
            log.append(f"{end.vehicle} begins")
            time.sleep(0.003)
            log.append(f"{end.vehicle} ends")
            end.sleep(0.1)

    run_programs(scenario(tmp_path, "c", "a", "b"), dict.fromkeys("cba", play), mcap=False)
    assert log == 5 * [f"{name} {verb}" for name in "abc" for verb in ("begins", "ends")]


def test_arrivals_during_a_programs_sleep_wait_in_order(tmp_path: Path) -> None:
    received: list[Any] = []

    def late(end: Socket) -> None:
        end.sleep(0.5)
        received.extend(end.recvfrom(0) for _ in range(6))
        with pytest.raises(TimeoutError, match="no message was received for 0 s"):
            end.recvfrom(0)
        assert end.time() == 0.5

    def tell(end: Socket) -> None:
        for number in range(3):
            end.sleep(0.1)
            end.sendto(b"%d" % number)

    run_programs(scenario(tmp_path, "a", "b", "c"), {"a": late, "b": tell, "c": tell}, mcap=False)
    assert [(data, sender) for data, sender in received] == [(b"%d" % n, sender) for n in range(3) for sender in "bc"]


def test_all_calls_end_with_the_run(tmp_path: Path) -> None:
    ended = list[str]()

    def play(end: Socket) -> None:
        end.sleep(0.9)
        for call in (lambda: end.sleep(0.1), lambda: end.sleep(0.0), end.recvfrom, lambda: end.sendto(b"")):
            with pytest.raises(RunOver):
                call()
        assert end.time() == 0.9
        assert list(end) == []
        ended.append(end.vehicle)

    def quietly(end: Socket) -> None:
        ended.append(end.run)
        end.recvfrom()

    result = run_programs(scenario(tmp_path, "a", "b"), {"a": play, "b": quietly}, mcap=False)
    assert sorted(ended) == ["a", "programs"]
    assert result.metrics["radio"]["frames"] == 0
    assert not (tmp_path / "s").exists()


def test_a_program_gets_the_run_and_its_vehicles_estimate(tmp_path: Path) -> None:
    results: list[Any] = []

    def play(end: Socket) -> None:
        results.append((end.run, end.vehicles, end.position()))
        for to in ("a", "c", ""):
            with pytest.raises(ValueError, match=r"not another vehicle of this run \(b\)"):
                end.sendto(b"", to)
        with pytest.raises(ValueError, match="65536 bytes"):
            end.sendto(bytes(65_536))
        for bad in (-1.0, float("nan"), float("inf"), 1e10):
            with pytest.raises(ValueError, match="seconds = "):
                end.sleep(bad)
            with pytest.raises(ValueError, match="timeout = "):
                end.recvfrom(bad)
        end.sleep(0.55)
        results.append(end.position())

    content = scenario(tmp_path, "a", "b")
    content["vehicle"][0]["agent"] = {"kind": "trajectory", "path": "straight", "speed": 1.0}
    run_programs(content, {"a": play, "b": idle}, mcap=False)
    (start, (x, y, z)) = results
    assert start == ("programs", ("a", "b"), (0.0, 0.0, 0.0))
    assert 0.3 < x < 0.51
    assert (y, z) == (0.0, 0.0)
