"""Emulated positioning system: error statistics, and its output read by the real readers."""

import math
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial  # type: ignore[import-untyped]

from tests.support.hardware.driver_runs import PATIENCE_S, eventually, open_resources
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.hardware.emulators.tags import (
    Errors,
    Tag,
    TagServer,
    circling,
    dwm1001_port,
    standing,
    ubisense_port,
)
from vcmvsp.hardware.localisation import dwm1001, ubisense
from vcmvsp.hardware.localisation.source import LineReader, Located

pytestmark = pytest.mark.sockets

TRUE = (3.0, -2.0, 0.5)


def fixes(count: int, **errors: Any) -> list[Located]:
    tag = Tag("A1", Errors(**errors), seed=7)
    return [tag.measure(TRUE, k) for k in range(count)]


def offsets(located: list[Located]) -> np.ndarray[Any, Any]:
    return np.array([each.position for each in located if each.position is not None]) - TRUE


def test_errors_have_the_given_spread() -> None:
    off = offsets(fixes(4000, sigma_m=0.2))
    assert np.abs(off.mean(axis=0)).max() < 4 * 0.2 / math.sqrt(4000)
    assert off.std(axis=0) == pytest.approx([0.2] * 3, rel=4 / math.sqrt(2 * 4000))


def test_outliers_and_drop_outs_have_their_rates_and_outliers_are_horizontal() -> None:
    n, p, q = 4000, 0.1, 0.05
    located = fixes(n, sigma_m=0.0, outliers=p, drop_outs=q, outlier_m=2.0)
    drop_out_count = sum(each.position is None for each in located)
    far = np.hypot(*offsets(located).T[:2])
    assert abs(drop_out_count - n * q) < 4 * math.sqrt(n * q * (1 - q))
    assert abs((far > 0).sum() - (n - drop_out_count) * p) < 4 * math.sqrt(n * p * (1 - p))
    assert 1.0 <= far[far > 0].min() <= far.max() <= 3.0
    assert not offsets(located)[:, 2].any()


def test_parameters_have_independent_draws() -> None:
    plain, others = fixes(200, sigma_m=0.1), fixes(200, sigma_m=0.1, outliers=0.2, drop_outs=0.2)
    same = [a.position == b.position for a, b in zip(plain, others, strict=True)]
    assert 0.5 < sum(same) / 200 < 0.8  # 0.64: neither outlier nor drop-out


def test_fixes_come_at_their_rate_and_late_by_the_latency() -> None:
    tag = Tag("A1", Errors(fix_hz=5.0, latency_s=0.3), seed=0)
    arrivals = []
    for ms in range(0, 2001, 10):
        arrivals += [(ms, located.source_ns) for located in tag.advance(ms * 1_000_000, standing((1.0, 2.0, 0.0)))]
    assert [ms for ms, _ in arrivals] == [*range(300, 2001, 200)]
    assert all(ms * 1_000_000 - (source or 0) == 300_000_000 for ms, source in arrivals)


def test_a_delayed_tag_does_not_repeat_missed_fixes_and_sends_none_without_a_true_pose() -> None:
    tag = Tag("A1", Errors(fix_hz=10.0), seed=0)
    assert len(tag.advance(0, standing((0.0, 0.0, 0.0)))) == 1
    assert len(tag.advance(5 * SECOND_NS, standing((0.0, 0.0, 0.0)))) == 1
    assert tag.due_ns == 5_100_000_000
    assert tag.advance(tag.due_ns, lambda: None) == []


@pytest.mark.parametrize("radius", [2.0, -2.0])
def test_a_circle_has_its_middle_at_the_left_or_at_the_right(radius: float) -> None:
    now = 0
    truth = circling((1.0, 1.0, math.pi / 2), radius, 0.5, now=lambda: now)
    for now in range(0, 60 * SECOND_NS, SECOND_NS):
        x, y, _, yaw = truth() or (math.nan,) * 4
        assert math.hypot(x - (1.0 - radius), y - 1.0) == pytest.approx(2.0)
        assert yaw == pytest.approx(math.pi / 2 + 0.25 * math.copysign(now / SECOND_NS, radius))


def test_datagrams_have_position_and_time() -> None:
    before = open_resources()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(PATIENCE_S)
        port = ubisense_port(*ear.getsockname())
        with TagServer(
            Tag("0000000000ABCDEF", Errors(fix_hz=50.0, sigma_m=0.01), 1), standing((1.0, 2.0, 0.0)), port
        ) as source:
            located = [ubisense.decode(ear.recv(100)) for _ in range(5)]
        assert source.told >= 5
        assert source.error is None
        source.close()
    assert {each.tag for each in located} == {"0000000000ABCDEF"}
    times = [each.source_ns or 0 for each in located]
    assert times == sorted(set(times))
    assert abs(times[0] - time.time_ns()) < 60 * SECOND_NS
    for each in located:
        assert each.position == pytest.approx((1.0, 2.0, 0.0), abs=0.06)
        assert each.sigma_m == pytest.approx(0.01, rel=1e-6)
    eventually(lambda: open_resources() <= before)


def test_a_tag_at_a_serial_port_reports_after_a_request(tmp_path: Path) -> None:
    before = open_resources()
    port = dwm1001_port(tmp_path / "tag")
    with TagServer(Tag("1", Errors(fix_hz=50.0, sigma_m=0.0), 1), standing((1.0, 2.0, 0.0)), port) as source:
        with serial.Serial(source.url, dwm1001.BAUD, timeout=0.02) as port:
            reader, found = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES), list[Located]()
            assert port.read(100) == b""
            port.write(dwm1001.WAKE)
            output = bytearray()
            eventually(lambda: output.extend(port.read(200)) or dwm1001.PROMPT.encode() in output)  # type: ignore[func-returns-value]
            port.write(dwm1001.POSITIONS)
            eventually(lambda: found.extend(reader.feed(port.read(200))) or len(found) >= 3)  # type: ignore[func-returns-value]
        assert {each.position for each in found} == {(1.0, 2.0, 0.0)}
        assert reader.invalid == 0
    assert not (tmp_path / "tag").is_symlink()
    eventually(lambda: open_resources() <= before)


def test_errors_of_a_source_are_raised() -> None:
    def truth() -> tuple[float, float, float, float]:
        raise RuntimeError("lost")

    source = TagServer(Tag("1", Errors(), 1), truth, ubisense_port("127.0.0.1", 9))
    eventually(lambda: source.error)
    with pytest.raises(RuntimeError, match="lost"):
        source.close()
    source.close()


def test_unavailable_ports_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "tag").touch()
    with pytest.raises(UsageError, match="tag: File exists"):
        dwm1001_port(tmp_path / "tag")
    with pytest.raises(UsageError, match=r"no\.such\.host"):
        ubisense_port("no.such.host.invalid", 5000)
