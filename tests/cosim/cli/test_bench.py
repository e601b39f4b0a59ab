"""``vcmvsp bench``: rows, exit codes and helpers of the programs in ``bench``; refusal where the sources are missing."""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import __main__ as bench
from bench import drones, growth, limits_files, messages, radio, shares
from bench.asked import SilentError, program
from bench.crowds import MOST, RADIOS, Reached, reach, team
from bench.growth import CASES, COUNTS, exponent
from bench.limits import DOCUMENT, SECTIONS, Section, placed
from bench.measure import Row, missing
from bench.messages import IDEAL, LEVELS, LOSS, Counter, talk
from bench.peers.simpy_air import talked
from bench.shares import PARTS, Case, Stopwatch
from bench.workloads import run_cpu_s
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.cli import reproduce
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.runs import api
from vcmvsp.physics.dynamics.bullet import p

pytestmark = pytest.mark.processes


def test_without_the_sources_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduce, "HOME", tmp_path)
    outcome = vcmvsp_command("bench")
    assert outcome.code == 2
    assert "in a checkout of the sources" in outcome.err


def test_an_unknown_part_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    assert vcmvsp_command("bench", "nothing").code == 2
    assert "there is no part 'nothing'" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("demand", "holds", "code"), [("<= 1x", True, 0), ("<= 1x", False, 1), ("goal: >= 2x real time", False, 0)]
)
def test_rows_as_json(
    demand: str, holds: bool, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = Row("it", "1 us", "2 us", 0.5, demand, holds)
    monkeypatch.setattr(bench, "PARTS", {"a": lambda: [row], "b": pytest.fail})
    assert bench.main(["a", "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert document["rows"] == [{"part": "a", **row._asdict()}]
    assert document["schema"] == "vcmvsp.bench/1"


def test_a_missing_measurement_is_no_number_and_no_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "PARTS", {"a": lambda: [missing("it", "<= 1x", "it is not there")]})
    assert bench.main(["--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["rows"]
    assert (row["ratio"], row["other"]) == (None, "not measured: it is not there")


def test_an_interruption_loses_no_row(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    row = Row("it", "1 us", "2 us", 0.5, "<= 1x", True)

    def part() -> Iterator[Row]:
        yield row
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "PARTS", {"a": part})
    assert bench.main(["--json"]) == 1
    assert [each["name"] for each in json.loads(capsys.readouterr().out)["rows"]] == ["it"]


def test_the_exponent_of_a_power_law() -> None:
    assert exponent([3.0 * count**1.5 for count in COUNTS]) == pytest.approx(1.5)


@pytest.mark.parametrize("name", CASES)
def test_every_part_of_a_run_is_clocked(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "DURATION_S", 0.3)
    found = growth.case_costs(3, CASES[name])
    parts = sum(found[part] for part in CASES[name].demands)
    assert all(found[part] > 0.0 for part in CASES[name].demands)
    assert parts == pytest.approx(found["whole"])
    assert found["event_bytes"] > 10.0


@given(limit=st.integers(2, MOST + MOST // 2), power=st.floats(0.5, 3.0), first=st.integers(1, MOST - 1))
def test_the_limit_of_a_power_law_is_between_two_measurements(limit: int, power: float, first: int) -> None:
    counts: list[int] = []

    def cost(count: int) -> float:
        counts.append(count)
        return float((count / (limit + 0.5)) ** power)

    found = reach(cost, first)
    assert abs(found.number - limit) <= 1
    assert sorted(found.measured) == sorted(set(counts))
    assert len(counts) == len(set(counts))
    if max(counts) > limit:
        assert min(counts) <= found.number <= max(counts)
    else:  # extrapolated beyond the largest number that is measured
        assert "reckoned" in found.words


def test_a_limit_far_beyond_the_measurements_is_no_number() -> None:
    assert reach(lambda count: 1e-6 * count, 96).words == f"more than {MOST}"
    assert reach(lambda _: 0.5, 96).words == f"more than {MOST}"
    assert reach(lambda _: 0.5, MOST).words == f"more than {MOST}"
    assert reach(lambda count: count / 1500.0, 96).words == f"about 1500, reckoned beyond {MOST} (0.68)"
    assert reach(lambda _: 3.0, 8).words == "fewer than 1 (3.00)"


def test_the_words_contain_both_measurements() -> None:
    assert Reached(150, {64: 0.2, 128: 0.75, 256: 2.5}).words == "150 (128: 0.75, 256: 2.50)"


@pytest.mark.parametrize("kind", ["kinematic", "p2dx", "quadrotor"])
def test_each_vehicle_of_a_team_reports(kind: str) -> None:
    found = growth.costs(team({kind: 3}, 1.0, RADIOS["ideal radio"], 2.0))
    assert found["arrived"] == 1.0
    assert run_cpu_s(team({kind: 2, "kinematic": 1}, 1.0, RADIOS["ideal radio"], 0.2)) > 0.0


def test_files_of_a_run_grow_with_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits_files, "VEHICLES", 3)
    monkeypatch.setattr(limits_files, "DURATION_S", 1.0)
    silent, talking = limits_files.left(limits_files.SILENT_HZ), limits_files.left(limits_files.TALKING_HZ)
    assert (silent.receptions, talking.receptions) == (0, 3 * 10 * 2)
    assert talking.mcap > silent.mcap
    assert talking.states == silent.states


def test_memory_of_the_process_per_state_and_per_reception(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits_files, "VEHICLES", 3)
    states, receptions, peak_bytes = limits_files.taken(limits_files.TALKING_HZ, 0.1, 1.0)
    assert (states, receptions) == (3 * 11, 3 * 10 * 2)
    assert peak_bytes > 2**20
    held = {limits_files.SHORT_S: (100, 10, 5e6), limits_files.LONG_S: (200, 30, 6e6)}
    monkeypatch.setattr(limits_files, "_fresh", lambda hz, period_s, duration_s: held[duration_s])
    assert limits_files.resident() == (1e4, 5e4)


def test_tables_are_put_in_their_places_and_nowhere_else() -> None:
    table = Section("a", ("x", "y"), [("1", "2")])
    page = "before\n<!-- measured: a -->\nold\n<!-- end -->\n<!-- measured: machine -->\n<!-- end -->\nafter\n"
    contents = {"a": table.markdown, "machine": "mine"}
    once = placed(page, contents)
    assert once == page.replace("old", "| x | y |\n| --- | --- |\n| 1 | 2 |").replace("machine -->\n", "machine -->\nmine\n")
    assert placed(once, contents) == once
    with pytest.raises(ValueError, match="0 places for 'b'"):
        placed(page, {"b": table.markdown})


def test_the_page_has_a_place_for_each_table() -> None:
    page = DOCUMENT.read_text("utf-8")
    names = [*(section.__name__ for section in SECTIONS), "machine"]
    again = placed(page, {name: f"the table {name}" for name in names})
    assert all(f"<!-- measured: {name} -->\nthe table {name}\n" in again for name in names)
    assert again.count("<!-- measured: ") == len(names)


def test_a_line_of_a_table_is_a_row_of_bench() -> None:
    (row,) = Section("a", ("what", "x", "y"), [("it", "1", "2")]).rows
    assert (row.name, row.ours, row.holds) == ("limits, a: it", "x: 1; y: 2", True)


HERE = Path(sys.executable)
NOWHERE = Path("nowhere/bin/python")


def test_a_program_answers_every_request() -> None:
    with program("simpy_air", HERE, agents=3, span_s=1.0) as stretch:
        assert [stretch() > 0.0 for _ in range(3)] == [True] * 3


def test_a_program_that_does_not_answer_is_an_error() -> None:
    with pytest.raises(SilentError, match=r"No module named bench\.peers\.nothing"), program("nothing", HERE):
        pass


@pytest.mark.parametrize("peer", drones.PEERS)
def test_a_row_without_its_peer_names_the_remedy(peer: drones.Peer) -> None:
    for count in peer.most:
        row = drones._row(count, peer._replace(python=NOWHERE))
        assert row.holds
        assert row.other == "not measured: it is not installed: make nowhere/.ready"


def test_a_row_of_messages_names_the_remedy() -> None:
    row = messages.beside(10, IDEAL, "nothing", "it", "gradysim_broadcast", NOWHERE, ">= 2 times less")
    assert row.other.endswith("make nowhere/.ready")


def test_rows_of_the_radio_name_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NS3_PREFIX", str(tmp_path))
    monkeypatch.setenv("NS3_RESULTS", str(tmp_path))
    monkeypatch.setattr(radio, "_thousand", lambda: pytest.fail("it is to be asked for only"))
    rows = radio.rows()
    for _ in range(3):
        row = next(rows)
        assert row.holds
        assert row.other.startswith("not measured: no ns-3: make .ns3/.ready")


@pytest.mark.parametrize("channel", [IDEAL, LEVELS], ids=["losses", "levels"])
def test_a_fifth_of_all_broadcasts_is_lost(channel: dict[str, object]) -> None:
    duration_s, count = 10.0, 5
    agents = {f"car{n}": Counter() for n in range(count)}
    api.run(talk(count, channel, duration_s), agents=agents, mcap=False)
    sent = 10 * duration_s - 1  # messages of the last tick arrive after the end
    shares = [each.received / (sent * (count - 1)) for each in agents.values()]
    assert shares == pytest.approx([1.0 - LOSS] * count, abs=0.08)


@pytest.mark.parametrize("loss", [0.0, LOSS, 1.0])
def test_the_simpy_program_has_the_given_loss(loss: float) -> None:
    count, span_s = 5, 20.0
    reception_count = sum(node.received for node in talked(count, span_s, loss))
    assert reception_count / (10 * span_s * count * (count - 1)) == pytest.approx(1.0 - loss, abs=0.03)


class Clock:
    """A simulated CPU clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr("time.process_time", lambda: self.now)


def test_an_inner_call_counts_only_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
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
    expected = {"start": 8.0, "physics": 3.0, "Bullet": 4.0, "kernel": 16.0, "end": 32.0}
    assert watch.spent() == dict.fromkeys(PARTS, 0.0) | expected


def test_after_a_failed_call_time_counts_for_its_caller(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_cost_of_the_clock_is_subtracted(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(10**9))
    monkeypatch.setattr("time.process_time", lambda: float(next(ticks)))  # each reading takes 1 s
    watch = Stopwatch()
    nothing = watch.clocked("recording", lambda: None)
    watch.change("kernel")
    for _ in range(1000):
        nothing()
    found = watch.spent()
    assert found["recording"] + found["kernel"] < 3.0


def test_every_part_of_a_run_has_a_share(monkeypatch: pytest.MonkeyPatch) -> None:
    short = Case("it", {"duration_s": 1.0, "metrics.from_s": 0.0}, study=True)
    monkeypatch.setattr(shares, "CASES", {"formation-circle": short})
    for name in ("begin", "advance"):
        monkeypatch.setattr(Kernel, name, getattr(Kernel, name))  # registered with monkeypatch: restored after the test
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
    assert {path.suffix for path in written} == {".csv", ".png", ".svg", ".pdf"}
    rows = list(csv.DictReader((tmp_path / "new" / "shares.csv").read_text().splitlines()))
    assert [(row["scenario"], float(row["end_s"])) for row in rows] == [("a", 1.0), ("b", float(len(PARTS)))]


def test_a_row_contains_all_shares() -> None:
    row = shares._row("formation-circle", {part: 2.0 if part == "Bullet" else 0.0 for part in PARTS})
    assert (row.ours, row.other, row.ratio) == ("Bullet 100 %", "2.0 CPU s", 1.0)
