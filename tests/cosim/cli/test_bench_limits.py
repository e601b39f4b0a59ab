"""How many vehicles a core carries is found between two that were measured, and the page's tables stand in their places."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import growth, limits_files
from bench.crowds import MOST, RADIOS, Reached, reach, team
from bench.limits import DOCUMENT, SECTIONS, Section, placed
from bench.workloads import run_cpu_s


@given(limit=st.integers(2, MOST + MOST // 2), power=st.floats(0.5, 3.0), first=st.integers(1, MOST - 1))
def test_of_a_power_the_number_is_found_between_two_that_were_measured(limit: int, power: float, first: int) -> None:
    asked: list[int] = []

    def cost(count: int) -> float:
        asked.append(count)
        return float((count / (limit + 0.5)) ** power)

    found = reach(cost, first)
    assert abs(found.number - limit) <= 1
    assert sorted(found.measured) == sorted(set(asked))
    assert len(asked) == len(set(asked))
    if max(asked) > limit:
        assert min(asked) <= found.number <= max(asked)
    else:  # beyond the most that is tried it is reckoned
        assert "reckoned" in found.words


def test_what_is_too_far_beyond_what_was_measured_is_no_number() -> None:
    assert reach(lambda count: 1e-6 * count, 96).words == f"more than {MOST}"
    assert reach(lambda _: 0.5, 96).words == f"more than {MOST}"
    assert reach(lambda _: 0.5, MOST).words == f"more than {MOST}"
    assert reach(lambda count: count / 1500.0, 96).words == f"about 1500, reckoned beyond {MOST} (0.68)"
    assert reach(lambda _: 3.0, 8).words == "fewer than 1 (3.00)"


def test_the_words_name_the_two_that_were_measured() -> None:
    assert Reached(150, {64: 0.2, 128: 0.75, 256: 2.5}).words == "150 (128: 0.75, 256: 2.50)"


@pytest.mark.parametrize("kind", ["kinematic", "p2dx", "quadrotor"])
def test_each_of_a_team_reports_so_often(kind: str) -> None:
    found = growth.costs(team({kind: 3}, 1.0, RADIOS["ideal radio"], 2.0))
    assert found["arrived"] == 1.0
    assert run_cpu_s(team({kind: 2, "kinematic": 1}, 1.0, RADIOS["ideal radio"], 0.2)) > 0.0


def test_what_a_run_leaves_grows_with_what_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits_files, "VEHICLES", 3)
    monkeypatch.setattr(limits_files, "DURATION_S", 1.0)
    silent, talking = limits_files.left(limits_files.SILENT_HZ), limits_files.left(limits_files.TALKING_HZ)
    assert (silent.receptions, talking.receptions) == (0, 3 * 10 * 2)
    assert talking.mcap > silent.mcap
    assert talking.states == silent.states


def test_memory_is_that_of_the_process_for_each_state_and_each_reception(monkeypatch: pytest.MonkeyPatch) -> None:
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
