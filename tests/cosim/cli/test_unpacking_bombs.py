"""Every reader answers to what unpacks to gigabytes in a few seconds and a gigabyte: with a result, or with one line."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim import unpacking_bombs as bombs
from tests.support.cosim.command_line import two_cars
from tests.support.cosim.measured_commands import Measured, answered, measured

pytestmark = pytest.mark.processes

READERS = ("report", "plot", "radio", "export --csv --force")
TREE = b"[" * bombs.DEEP
Make = Callable[[Path], object]


def recording_of(chunks: Callable[[], object]) -> Make:
    return lambda folder: bombs.recording(folder / "run.mcap", chunks(), "car1 car2")  # type: ignore[arg-type]


IN_RESULTS: dict[str, Make] = {
    "radio rows": lambda folder: bombs.rows(folder / "radio.parquet", folder / "radio.parquet"),
    "state rows": lambda folder: bombs.rows(folder / "states.parquet", folder / "states.parquet"),
    "long word": lambda folder: bombs.long_text(folder / "radio.parquet", folder / "radio.parquet"),
    "long messages": recording_of(bombs.zeros),
    "large chunk": recording_of(lambda: bombs.zeros(part=1_000_000_000)),
    "many messages": recording_of(bombs.many),
    "deep note": recording_of(lambda: bombs.one("car1/note", "vcmvsp.Note", b'{"values":' + TREE)),
    "deep line": recording_of(lambda: bombs.one("log", "foxglove.Log", b'{"x":' + TREE)),
    "deep frame": recording_of(lambda: bombs.one("radio/frame", "vcmvsp.Frame", b'{"x":' + TREE)),
    "empty note": recording_of(lambda: bombs.one("car1/note", "vcmvsp.Note", b"")),
    "empty frame": recording_of(lambda: bombs.one("radio/frame", "vcmvsp.Frame", b"")),
    "deep metrics": lambda folder: (folder / "metrics.json").write_bytes(TREE),
    "deep about": lambda folder: (folder / "about.json").write_bytes(TREE),
    "deep scenario": lambda folder: (folder / "scenario.toml").write_bytes(b"a = " + TREE),
    "long metrics": lambda folder: bombs.sparse(folder / "metrics.json"),
    "long about": lambda folder: bombs.sparse(folder / "about.json"),
    "long scenario": lambda folder: bombs.sparse(folder / "scenario.toml"),
}


WITHOUT_TABLES = ("long messages", "many messages", "deep frame", "empty frame")
"""Of these the tables are missing, as if the run were cut: all readers read the recording."""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Measured]:
    """What the readers say to each of the folders."""
    runs = tmp_path_factory.mktemp("runs")
    (runs / "s.toml").write_text(two_cars())
    vcmvsp.run(runs / "s.toml", out=runs / "run", set={"duration_s": 1.0})
    asked = {}
    for name, make in IN_RESULTS.items():
        folder = Path(shutil.copytree(runs / "run", runs / name.replace(" ", "-")))
        make(folder)
        for path in folder.glob("*.parquet") if name in WITHOUT_TABLES else ():
            path.unlink()
        asked.update({(name, reader): f"{reader} {folder}" for reader in READERS})
    return dict(zip(asked, measured(list(asked.values())), strict=True))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", IN_RESULTS)
def test_results_are_read_or_refused_at_little_cost(name: str, reader: str, answers: dict[tuple[str, str], Measured]) -> None:
    answered(answers[name, reader])
