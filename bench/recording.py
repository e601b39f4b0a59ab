"""Cost of recording: time and bytes per event, and memory per receiver of a frame.

``python -m bench.recording`` prints the table. CPU time of this process, medians of pairs; memory is that of Python's and
NumPy's allocations, the difference between a run and one twice as long.
"""

import functools
import gc
import io
import platform
import tracemalloc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from bench.growth import crowd
from bench.measure import Row, cpu, in_turn, measured, table
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA
from vcmvsp.cosim.util.codec import encode

ROUNDS = 7
VEHICLES, RUN_S = 10, 20.0
HELD_VEHICLES, HELD_S, PRESET = 50, 10.0, "wifi-g-24"  # more receptions than a run keeps in memory in any case
HELD_BYTES = 40  # per receiver of a frame, while a run goes on and at its end
TEXT_BYTES = 4  # a text is a number in a dictionary
FIXED_BYTES = [field.type.bit_width // 8 for field in RADIO_SCHEMA if field.type.num_fields == 0]
TABLE_BYTES = sum(FIXED_BYTES) + TEXT_BYTES * (len(RADIO_SCHEMA) - len(FIXED_BYTES))


class Run(NamedTuple):
    """All events of a run, and a way to make its recorder."""

    events: Sequence[Event]
    recorder: Callable[..., Recorder]
    end_ns: int


def run_of(scenario: dict[str, Any]) -> Run:
    """A run whose events are collected instead of recorded."""
    parsed, source = scenarios.load(scenario)
    events: list[Event] = []
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()
        kernel.run(events.append)
        kernel.close()
        return Run(events, assembled.recorder, kernel.now_ns)


def recorded(run: Run, mcap: io.BytesIO | None) -> Recorder:
    """A recorder after all events."""
    recorder = run.recorder(mcap=mcap)
    for event in run.events:
        recorder.on(event)
    recorder.close(run.end_ns)
    return recorder


def event_s() -> Row:
    """Time of an event into the tables and ``run.mcap``; beside the same events encoded and concatenated."""
    run = run_of(crowd(VEHICLES, "kinematic", "ideal", RUN_S))

    def bare() -> None:
        stream = io.BytesIO()
        for event in run.events:
            stream.write(encode((event.key, event.time_ns, event.value)))

    ours, other, ratio = in_turn(lambda: cpu(lambda: recorded(run, io.BytesIO())), lambda: cpu(bare), ROUNDS)
    count = len(run.events)
    name = f"recording, {VEHICLES} vehicles that all hear each other, an event; beside MessagePack alone"
    return Row(name, f"{1e6 * ours / count:.1f} us", f"{1e6 * other / count:.1f} us", ratio, "<= 8x", ratio <= 8.0)


def event_bytes() -> Row:
    """Bytes of ``run.mcap`` for an event; beside MessagePack, not compressed."""
    run, stream = run_of(crowd(VEHICLES, "kinematic", "ideal", RUN_S)), io.BytesIO()
    recorded(run, stream)
    count = len(run.events)
    ours = stream.tell() / count
    other = sum(len(encode((event.key, event.time_ns, event.value))) for event in run.events) / count
    name = "recording, bytes of run.mcap per event; beside MessagePack, not compressed"
    return Row(name, f"{ours:.0f} B", f"{other:.0f} B", ours / other, "<= 1x", ours <= other)


def held() -> Row:
    """Memory of a frame at each of its receivers while the run goes on; beside the row of the table."""
    held, _ = _bytes_per_row()
    name = f"memory of a run, {HELD_VEHICLES} vehicles, per receiver of a frame; beside its row of the table"
    return Row(name, f"{held:.0f} B", f"{TABLE_BYTES} B", held / TABLE_BYTES, f"<= {HELD_BYTES} B", held <= HELD_BYTES)


def peak() -> Row:
    """Memory at the end of the run, when tables and metrics are made."""
    _, peak = _bytes_per_row()
    name = "the same at the end of the run, when tables and metrics are made"
    return Row(name, f"{peak:.0f} B", f"{TABLE_BYTES} B", peak / TABLE_BYTES, f"<= {HELD_BYTES} B", peak <= HELD_BYTES)


@functools.cache
def _bytes_per_row() -> tuple[float, float]:
    """Memory at the end of a run, and its peak until the metrics are computed."""
    tracemalloc.start()
    try:
        _held(2.0 * HELD_S)  # objects made once in a process
        short, long = _held(HELD_S), _held(2.0 * HELD_S)
    finally:
        tracemalloc.stop()
    rows = long[0] - short[0]
    return (long[1] - short[1]) / rows, (long[2] - short[2]) / rows


def _held(duration_s: float) -> tuple[int, int, int]:
    """Rows of a run's table, bytes held at its end, and the peak until the metrics are computed."""
    parsed, source = scenarios.load(
        {**crowd(HELD_VEHICLES, "kinematic", PRESET, duration_s), "record": {"period_s": duration_s}}
    )
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()
        recorder = assembled.recorder(None)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        kernel.run(recorder.on)
        recorder.close(kernel.now_ns)
        kernel.close()
        gc.collect()
        held, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        recorder.metrics(window=(0.0, None))
        _, peak = tracemalloc.get_traced_memory()
        return recorder.tables[1].num_rows, held - before, peak - before


def rows() -> list[Row]:
    """All rows."""
    return measured((event_s, event_bytes, held, peak))


if __name__ == "__main__":
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    print(table(rows()))
