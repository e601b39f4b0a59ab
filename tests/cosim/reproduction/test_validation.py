"""``vcmvsp validate``: quick checks hold, a law that is broken is told with its row, no figure is left out."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.command_line import Outcome, vcmvsp_command
from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.row import Row
from vcmvsp.cosim.reproduction.validation import CHECKS, chosen, document, levels
from vcmvsp.cosim.reproduction.validation import check as kit
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.path_loss import Friis

QUICK = (
    *("ticks", "draws", "path-loss", "walls", "shadowing", "success", "received", "air-time", "age", "dcf-b-50"),
    *("scanner", "inertial", "positions", "wheels", "figure-25"),
)


def validated(folder: Path, *names: str) -> Outcome:
    only = [argument for name in names for argument in ("--only", name)]
    return vcmvsp_command("validate", "--jobs", "1", "--out", str(folder), *only)


@pytest.mark.parametrize("name", QUICK)
def test_a_quick_check_holds(name: str) -> None:
    outcome = kit.measured(CHECKS[name])
    assert document.failures([outcome]) == []
    cases = [row.case for row in outcome.rows]
    assert len(set(cases)) == len(cases) > 0


def test_every_figure_has_a_check_and_every_check_a_source() -> None:
    of_figures = {check.settings["name"] for check in CHECKS.values() if check.measure == "check:figure_rows"}
    assert of_figures == {*figures.NAMES}
    assert all(check.source and check.title and ":" in check.measure for check in CHECKS.values())


def test_what_is_written_says_it_all_and_is_the_same_each_time(tmp_path: Path) -> None:
    given = [validated(tmp_path / name, "received", "draws") for name in ("a", "b")]
    assert [each.code for each in given] == [0, 0]
    texts = [(tmp_path / name / "VALIDATION.md").read_text() for name in ("a", "b")]
    assert texts[0] == texts[1]
    assert f"2 of {len(CHECKS)} checks, 9 rows, all hold." in texts[0]
    assert texts[0].index("### draws") < texts[0].index("### received")  # in the order of the document, not of the arguments
    told = json.loads((tmp_path / "a" / "validation.json").read_text())
    assert told["ok"]
    assert [check["name"] for check in told["checks"]] == ["draws", "received"]
    assert [len(check["rows"]) for check in told["checks"]] == [3, 6]
    assert all(f"| {row['case']} |" in texts[0] for check in told["checks"] for row in check["rows"])


def test_a_law_that_is_broken_is_told_with_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Friis.loss_db

    def wrong(self: Friis, paths: Any) -> Floats:
        return right(self, paths) + 1e-3

    monkeypatch.setattr(Friis, "loss_db", wrong)
    given = validated(tmp_path, "path-loss", "draws")
    assert given.code == 1
    off = [line.strip() for line in given.err.splitlines() if line.startswith("  ")]
    assert len(off) == len(levels.DISTANCES_M)
    assert off[0] == "path-loss: friis, 1 m: loss, dB: 40.053, not 40.052 within 0.0001"
    assert (tmp_path / "VALIDATION.md").read_text().count("**OFF**") == len(off)
    assert not json.loads((tmp_path / "validation.json").read_text())["ok"]


def test_a_check_that_breaks_off_is_told_and_the_others_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ValueError("no such thing")

    monkeypatch.setattr(levels, "path_loss", broken)
    given = validated(tmp_path, "path-loss", "draws")
    assert given.code == 1
    assert "path-loss: ValueError: no such thing" in given.err
    assert "ok   draws" in given.out
    assert "broke off" in (tmp_path / "VALIDATION.md").read_text()


def test_no_rows_and_no_numbers_do_not_hold() -> None:
    check = CHECKS["draws"]
    assert not kit.Outcome(check).ok
    assert not kit.Outcome(check, [Row("it", 0.0, float("nan"), 1.0)]).ok
    assert json.loads(document.as_json([kit.Outcome(check, [Row("it", 0.0, float("nan"), 1.0)])]), parse_constant=pytest.fail)


def test_checks_in_processes_give_the_same() -> None:
    checks = chosen(["draws", "air-time", "received"])
    here, there = kit.run_all(checks, 1, lambda *_: None), kit.run_all(checks, 2, lambda *_: None)
    assert here == there
    assert [each.check.name for each in there] == ["draws", "received", "air-time"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--only", "path-los"), "did you mean 'path-loss'"),
        (("--jobs", "0"), "--jobs 0: must be 1 or more"),
        (("--out", __file__), "there is a file of that name"),
    ],
)
def test_bad_arguments_end_before_the_first_check(arguments: tuple[str, ...], words: str) -> None:
    given = vcmvsp_command("validate", *arguments)
    assert given.code == 2
    assert words in given.err
