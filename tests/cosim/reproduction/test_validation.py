"""``vcmvsp validate``: quick checks hold, a broken law is reported with its row, every figure has a check."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.command_line import Outcome, contents, vcmvsp_command
from tests.support.paths import ROOT
from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.row import Row
from vcmvsp.cosim.reproduction.validation import CHECKS, chosen, document, measured, radio, run_all
from vcmvsp.cosim.reproduction.validation import Outcome as Measured
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.path_loss import Friis

pytestmark = pytest.mark.processes

QUICK = (
    *("ticks", "draws", "path-loss", "walls", "shadowing", "success", "received", "air-time", "age", "dcf-b-50", "late-loop"),
    *("scanner", "inertial", "positions", "figure-25"),
)


def validated(folder: Path, *names: str) -> Outcome:
    only = [argument for name in names for argument in ("--only", name)]
    return vcmvsp_command("validate", "--jobs", "1", "--out", str(folder), *only)


def cells(line: str) -> list[str]:
    """Cells of a line of VALIDATION.md: name, title, source, rows, used and off."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


@pytest.mark.parametrize("name", QUICK)
def test_a_quick_check_holds(name: str) -> None:
    outcome = measured(CHECKS[name])
    assert document.failures([outcome]) == []
    cases = [row.case for row in outcome.rows]
    assert len(set(cases)) == len(cases) > 0
    (committed,) = (line for line in (ROOT / "VALIDATION.md").read_text().splitlines() if line.startswith(f"| `{name}` |"))
    assert cells(committed)[:4] == cells(document.head_line(outcome))[:4]


def test_every_figure_has_a_check_and_every_check_a_source() -> None:
    of_figures = {check.measure for check in CHECKS.values() if ":" not in check.measure}
    assert of_figures == {*figures.NAMES}
    assert all(check.source and check.title for check in CHECKS.values())


def test_files_contain_every_row_and_are_equal_each_time(tmp_path: Path) -> None:
    outcomes = [validated(tmp_path / name, "received", "draws") for name in ("a", "b")]
    assert [each.code for each in outcomes] == [0, 0]
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    head = (tmp_path / "a" / "VALIDATION.md").read_text()
    assert f"2 of {len(CHECKS)} checks, 9 rows, all hold." in head
    assert head.index("| `draws` |") < head.index("| `received` |")  # order of the document, not of the arguments
    document = json.loads((tmp_path / "a" / "validation.json").read_text())
    assert document["ok"]
    assert [(check["name"], len(check["rows"])) for check in document["checks"]] == [("draws", 3), ("received", 6)]
    with (tmp_path / "a" / "validation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["check"] for row in rows] == ["draws"] * 3 + ["received"] * 6
    assert [row["case"] for row in rows] == [row["case"] for check in document["checks"] for row in check["rows"]]


def test_the_committed_document_lists_every_check_and_all_hold() -> None:
    head, _, table = (ROOT / "VALIDATION.md").read_text().partition("|--:|--:|--:|\n")
    lines = [cells(line) for line in table.splitlines()]
    assert [line[:3] for line in lines] == [cells(document.head_line(Measured(check)))[:3] for check in CHECKS.values()]
    assert f"**{len(CHECKS)} of {len(CHECKS)} checks, {sum(int(line[3]) for line in lines)} rows, all hold.**" in head
    assert all(float(line[4]) <= 1.0 and line[5] == "0" for line in lines)


def test_a_broken_law_is_reported_with_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Friis.loss_db

    def wrong(self: Friis, paths: Any) -> Floats:
        return right(self, paths) + 1e-3

    monkeypatch.setattr(Friis, "loss_db", wrong)
    outcome = validated(tmp_path, "path-loss", "draws")
    assert outcome.code == 1
    off = [line.strip() for line in outcome.err.splitlines() if line.startswith("  ")]
    assert len(off) == len(radio.DISTANCES_M)
    assert off[0] == "path-loss: friis, 1 m: loss, dB: 40.053, not 40.052 within 0.0001"
    assert f"| **{len(off)}** |" in (tmp_path / "VALIDATION.md").read_text()
    assert not json.loads((tmp_path / "validation.json").read_text())["ok"]


def test_an_aborted_check_is_reported_and_the_others_continue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ValueError("no such thing")

    monkeypatch.setattr(radio, "path_loss", broken)
    outcome = validated(tmp_path, "path-loss", "draws")
    assert outcome.code == 1
    assert "path-loss: ValueError: no such thing" in outcome.err
    assert "ok   draws" in outcome.out
    assert "broke off" in (tmp_path / "VALIDATION.md").read_text()


def test_no_rows_and_no_numbers_fail() -> None:
    check = CHECKS["draws"]
    assert not Measured(check).ok
    assert not Measured(check, [Row("it", 0.0, float("nan"), 1.0)]).ok
    assert json.loads(document.as_json([Measured(check, [Row("it", 0.0, float("nan"), 1.0)])]), parse_constant=pytest.fail)


def test_checks_in_processes_are_equal() -> None:
    checks = chosen(["draws", "air-time", "received"])
    here, there = run_all(checks, 1, lambda *_: None), run_all(checks, 2, lambda *_: None)
    assert here == there
    assert [each.check.name for each in there] == ["draws", "received", "air-time"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--only", "path-los"), "did you mean 'path-loss'"),
        (("--jobs", "0"), "--jobs 0: must be 1 or more"),
        (("--out", __file__), "is a file; name a folder"),
    ],
)
def test_bad_arguments_end_before_the_first_check(arguments: tuple[str, ...], words: str) -> None:
    outcome = vcmvsp_command("validate", *arguments)
    assert outcome.code == 2
    assert words in outcome.err
