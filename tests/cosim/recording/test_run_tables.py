"""Tables of a cut run, from its recording: equal to the run's own tables."""

import re
import shutil
from pathlib import Path

import pytest

from tests.support.cosim import export_runs
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.recorded_run import tables_of

pytestmark = pytest.mark.slow

RUN = "a crossing cart"


@pytest.mark.parametrize("run", [RUN, "lab-patrol"])
def test_the_whole_recording_gives_the_tables_of_the_run(run: str, tmp_path: Path) -> None:
    whole, found = (
        tables_of(folder) for folder in (export_runs.run_of(run), export_runs.truncated_copy(run, tmp_path / "cut", 1.0))
    )
    assert found.facts == whole.facts
    assert found.states.equals(whole.states)
    for name in whole.radio.column_names:
        found_column, whole_column = (table.radio[name].to_pylist() for table in (found, whole))
        assert repr(found_column) == repr(whole_column), name  # NaN equals NaN


@pytest.mark.usefixtures("figures")
def test_a_cut_run_is_explained_and_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    folder = export_runs.truncated_copy(RUN, tmp_path / "cut", 0.7)
    words = r"no states.parquet here \(the run continues or was killed\): data come from run.mcap, up to [0-2]\.\d{3} s, "
    for command in (("radio", str(folder)), ("radio", str(folder), "--link", "car-1/car-2"), ("plot", str(folder))):
        outcome = vcmvsp_command(*command)
        assert outcome.code == 0, outcome.err
        assert outcome.out
        assert len(outcome.err.splitlines()) == 1
        assert re.search(words, outcome.err)
    assert {"trajectory.png", "formation_error.png"} <= {path.name for path in folder.iterdir()}
    shutil.copyfile(export_runs.run_of(RUN) / "scenario.toml", folder / "scenario.toml")
    at = ("radio", str(folder), "--coverage", "car-1", "--at", "0.1", "--resolution", "2", "--out", str(tmp_path / "map.png"))
    assert vcmvsp_command(*at).code == 0


def test_an_empty_recording_is_named(tmp_path: Path) -> None:
    folder = export_runs.truncated_copy(RUN, tmp_path / "cut", 1.0)
    shutil.copyfile(folder / "run.mcap", tmp_path / "all")
    head = next(size for size in range(100, 2000) if _is_empty_recording(folder, tmp_path / "all", size))
    assert head < 2000
    for command in ("radio", "plot"):
        outcome = vcmvsp_command(command, str(folder))
        assert (outcome.code, outcome.out) == (2, "")
        assert "run.mcap is still empty" in outcome.err


def _is_empty_recording(folder: Path, whole: Path, size: int) -> bool:
    """Whether the first ``size`` bytes of a recording identify the run and contain no data."""
    (folder / "run.mcap").write_bytes(whole.read_bytes()[:size])
    try:
        tables_of(folder)
    except UsageError as error:
        return "is still empty" in str(error)
    return False
