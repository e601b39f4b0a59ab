"""``hardware.mcap``: inputs are read back bit for bit and in order; damage costs what follows it, a crash one second."""

import contextlib
import io
import math
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from tests.support.paths import ROOT
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.external_inputs import Input, InputLog, read_inputs
from vcmvsp.cosim.types import Fix, Later, Measured, Odometry, Scan, VehicleState, Velocity, frozen
from vcmvsp.cosim.util import codec

pytestmark = pytest.mark.processes

MS = 1_000_000
numbers = st.floats(width=64)  # with infinities, NaN, -0.0, subnormals
vectors = st.tuples(numbers, numbers, numbers)
states = st.builds(VehicleState, position=vectors, velocity=vectors, angular_velocity=vectors)
odometry = st.builds(Odometry, pose=vectors, v=numbers, w=numbers)
fixes = st.builds(Fix, time_ns=st.integers(-(2**40), 2**62), position=vectors, yaw=st.none() | numbers, sigma_m=numbers)
ranges = st.dictionaries(st.text(max_size=5), numbers, max_size=4)
values = states | odometry | fixes | st.builds(Measured, time_ns=st.integers(0, 2**62), values=ranges)
keys = st.sampled_from(["car1/estimate", "car1/reflected", "car2/sonar", "car2/fix"])  # each of any type


def written(inputs: list[Input]) -> bytes:
    log = InputLog()
    log.open()
    for each in inputs:
        log.on(*each)
    log.close()
    return log.content


def drive(count: int) -> list[Input]:
    """An estimate every 0.1 s."""
    return [("car1/estimate", k * 100 * MS, VehicleState(position=(0.1 * k, 1 / 3, 0.0))) for k in range(count)]


def bits(inputs: list[Input]) -> list[tuple[str, int, type, bytes]]:
    """A form that distinguishes NaNs and the signs of zero."""
    return [(key, time_ns, type(value), codec.encode(value)) for key, time_ns, value in inputs]


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.tuples(keys, st.integers(0, 10**9), values), max_size=30))
def test_inputs_are_read_back_bit_for_bit(tmp_path: Path, steps: list[tuple[str, int, Any]]) -> None:
    inputs, now_ns = list[Input](), 0
    for key, step_ns, value in steps:
        now_ns += step_ns
        inputs.append((key, now_ns, value))
    path = tmp_path / "hardware.mcap"
    path.write_bytes(written(inputs))
    assert bits(read_inputs(path)) == bits(inputs)


def test_arrays_and_readings_on_demand(tmp_path: Path) -> None:
    scan = Scan(ranges=frozen([1.5, math.inf, -math.inf], np.float32), angle_min=-1.0, angle_step=0.1, range_max=8.0)
    path = tmp_path / "hardware.mcap"
    path.write_bytes(written([("car1/scan", 0, scan), ("car1/late", 5, Later(lambda: scan))]))  # type: ignore[list-item]
    for _, _, value in read_inputs(path):
        assert isinstance(value, Scan)
        assert value.ranges.dtype == np.float32
        assert value.ranges.tobytes() == scan.ranges.tobytes()
        assert not value.ranges.flags.writeable


def test_the_same_inputs_give_the_same_file() -> None:
    assert written(drive(50)) == written(drive(50))


def test_the_mcap_library_reads_it() -> None:
    """The MCAP library reads it through the index: a MessagePack map under a schema with the names of the fields."""
    inputs: list[Input] = [*drive(25), ("car1/command", 2500 * MS, Velocity(linear=(0.5, 0.0, 0.0)))]
    reader = make_reader(io.BytesIO(written(inputs)), validate_crcs=True)
    found = list(reader.iter_messages())
    assert [(channel.topic, message.log_time) for _, channel, message in found] == [each[:2] for each in inputs]
    schema, channel, message = found[-1]
    assert schema is not None
    assert (schema.name, channel.message_encoding) == ("vcmvsp.Velocity", "msgpack")
    assert "linear: tuple[float, float, float]\nyaw_rate: float\n" in schema.data.decode()
    assert msgspec.msgpack.decode(message.data) == {"type": "velocity", "linear": [0.5, 0.0, 0.0], "yaw_rate": 0.0}
    assert reader.get_summary() is not None


@pytest.fixture(scope="module")
def whole() -> bytes:
    return written(drive(60))


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_cut_file_keeps_its_beginning(tmp_path: Path, whole: bytes, data: st.DataObject) -> None:
    path, lines = tmp_path / "cut.mcap", list[str]()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with contextlib.suppress(UsageError):  # nothing readable is left
        found = read_inputs(path, tell=lines.append)
        assert bits(found) == bits(drive(60)[: len(found)])
        if len(found) < 60:
            assert lines == [f"{path} is damaged (it is truncated): it can be read up to {found[-1][1] / 1e9:.3f} s"]


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_flipped_bit_adds_no_input(tmp_path: Path, whole: bytes, data: st.DataObject) -> None:
    """Chunks have checksums."""
    changed = bytearray(whole)
    changed[data.draw(st.integers(0, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "flipped.mcap"
    path.write_bytes(changed)
    with contextlib.suppress(UsageError):
        assert {*bits(read_inputs(path))} <= {*bits(drive(60))}


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n", struct.pack("<8B", *range(8)) * 100])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "hardware.mcap"
    with pytest.raises(UsageError, match="No such file"):
        read_inputs(path)
    path.write_bytes(content)
    with pytest.raises(UsageError, match="cannot be read"):
        read_inputs(path)


def test_an_unknown_type_ends_the_file(tmp_path: Path) -> None:
    class Unknown(msgspec.Struct, tag="unknown"):
        x: float = 0.0

    path, lines = tmp_path / "hardware.mcap", list[str]()
    path.write_bytes(written([*drive(3), ("car1/estimate", 10**9, Unknown())]))  # type: ignore[list-item]
    assert len(read_inputs(path, tell=lines.append)) == 3
    assert "is damaged" in lines[0]


WRITER = """
import sys, time
from vcmvsp.cosim.recording.external_inputs import InputLog
from vcmvsp.cosim.types import VehicleState
with open(sys.argv[1], "wb") as stream:
    log = InputLog()
    log.open(stream)
    for k in range(60):
        log.on("car1/estimate", k * 100_000_000, VehicleState(position=(0.1 * k, 1 / 3, 0.0)))
    print("written", flush=True)
    time.sleep(60)
"""


def test_a_killed_process_loses_at_most_one_second(tmp_path: Path) -> None:
    path = tmp_path / "hardware.mcap"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", WRITER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "written\n"
        finally:
            writer.kill()
    found = read_inputs(path)
    assert bits(found) == bits(drive(60)[: len(found)])
    assert found[-1][1] >= (59 * 100 - 1000) * MS
