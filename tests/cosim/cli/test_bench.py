"""``vcmvsp bench``: the rows of the programs in ``bench``, where there are any."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench import __main__ as bench
from bench import growth
from bench.growth import CASES, COUNTS, exponent
from bench.measure import Row, missing
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.cli import reproduce


def test_without_the_sources_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduce, "HOME", tmp_path)
    given = vcmvsp_command("bench")
    assert given.code == 2
    assert "in a checkout of the sources" in given.err


def test_a_part_that_is_none_ends_it(capfd: pytest.CaptureFixture[str]) -> None:
    assert vcmvsp_command("bench", "nothing").code == 2
    assert "there is no part 'nothing'" in capfd.readouterr().err


@pytest.mark.parametrize("holds", [True, False])
def test_rows_as_json(holds: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    row = Row("it", "1 us", "2 us", 0.5, "<= 1x", holds)
    monkeypatch.setattr(bench, "PARTS", {"a": lambda: [row], "b": pytest.fail})
    assert bench.main(["a", "--json"]) == (0 if holds else 1)
    told = json.loads(capsys.readouterr().out)
    assert told["rows"] == [{"part": "a", **row._asdict()}]
    assert told["schema"] == "vcmvsp.bench/1"


def test_what_could_not_be_measured_is_no_number_and_no_failure(
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


def test_the_exponent_of_a_power_is_that_power() -> None:
    assert exponent([3.0 * count**1.5 for count in COUNTS]) == pytest.approx(1.5)


@pytest.mark.parametrize("name", CASES)
def test_every_part_of_a_run_is_clocked(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "DURATION_S", 0.3)
    found = growth.case_costs(3, CASES[name])
    parts = sum(found[part] for part in CASES[name].demands)
    assert all(found[part] > 0.0 for part in CASES[name].demands)
    assert parts == pytest.approx(found["whole"])
    assert found["event_bytes"] > 10.0
