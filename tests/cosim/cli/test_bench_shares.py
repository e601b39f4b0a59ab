"""Where the CPU time of a run goes: nothing is counted twice, and nothing is left out."""

import csv
from pathlib import Path

import pytest

from bench import shares
from bench.shares import PARTS, Case, Stopwatch
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.physics.dynamics.bullet import p


class Clock:
    """CPU time that goes on when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr("time.process_time", lambda: self.now)


def test_what_is_called_counts_as_its_own_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    watch = Stopwatch()

    def go_on(seconds: float) -> None:
        clock.now += seconds

    def step() -> None:
        go_on(1.0)
        watch.clocked("Bullet", go_on)(4.0)
        go_on(2.0)

    go_on(8.0)
    watch.change("kernel")
    watch.clocked("physics", step)()
    go_on(16.0)
    watch.change("end")
    go_on(32.0)
    told = {"start": 8.0, "physics": 3.0, "Bullet": 4.0, "kernel": 16.0, "end": 32.0}
    assert watch.spent() == dict.fromkeys(PARTS, 0.0) | told


def test_a_call_that_fails_gives_the_time_back_to_its_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    watch = Stopwatch()

    def fail() -> None:
        clock.now += 1.0
        raise KeyError

    watch.change("kernel")
    with pytest.raises(KeyError):
        watch.clocked("radio", fail)()
    clock.now += 2.0
    assert (watch.spent()["radio"], watch.spent()["kernel"]) == (1.0, 2.0)


def test_what_the_clock_takes_is_taken_off(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(10**9))
    monkeypatch.setattr("time.process_time", lambda: float(next(ticks)))  # each look at it takes a second
    watch = Stopwatch()
    nothing = watch.clocked("recording", lambda: None)
    watch.change("kernel")
    for _ in range(1000):
        nothing()
    found = watch.spent()
    assert found["recording"] + found["kernel"] < 3.0


def test_every_part_of_a_run_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    short = Case("it", {"duration_s": 1.0, "metrics.from_s": 0.0}, study=True)
    monkeypatch.setattr(shares, "CASES", {"formation-circle": short})
    monkeypatch.setattr(Kernel, "run", Kernel.run)  # so that both are put back
    monkeypatch.setattr(p, "stepSimulation", p.stepSimulation)
    found = shares.spent("formation-circle")
    assert all(found[part] > 0.0 for part in PARTS)


def test_the_parts_of_each_bar_fill_it(tmp_path: Path) -> None:
    found = {name: {part: 1.0 + place * number for number, part in enumerate(PARTS)} for place, name in enumerate("ab")}
    (axes,) = shares.draw(found).axes
    for place in range(len(found)):
        bars = [bar for bar in axes.patches if round(bar.get_y() + 0.5 * bar.get_height()) == place]
        assert len(bars) == len(PARTS)
        assert sum(bar.get_width() for bar in bars) == pytest.approx(100.0)
    written = shares.write(found, tmp_path / "new")
    assert {path.suffix for path in written} == {".csv", ".png", ".svg"}
    rows = list(csv.DictReader((tmp_path / "new" / "shares.csv").read_text().splitlines()))
    assert [(row["scenario"], float(row["end_s"])) for row in rows] == [("a", 1.0), ("b", float(len(PARTS)))]


def test_a_row_tells_all_shares() -> None:
    row = shares._row("formation-circle", {part: 2.0 if part == "Bullet" else 0.0 for part in PARTS})
    assert (row.ours, row.other, row.ratio) == ("Bullet 100 %", "2.0 CPU s", 1.0)
