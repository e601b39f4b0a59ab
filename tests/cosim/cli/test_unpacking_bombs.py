"""Every reader of results answers within a few seconds and a gigabyte, however large they unpack: a result, or one line."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim import unpacking_bombs as bombs
from tests.support.cosim.command_line import two_cars
from tests.support.cosim.measured_commands import CommandCost, assert_answered, measure_commands

pytestmark = pytest.mark.processes

TREE = b"[" * bombs.DEEP
Make = Callable[[Path], object]
FRAME = "radio {} --link car1/car2 --frame worst"
TABLE = ("report {}", "plot {}", "radio {} --link car1/car2")
RADIO = (*TABLE, "export {} --csv --out {}/x", "replay {} --radio recorded --out {}/x")
EXPORTS = tuple(f"export {{}} --{output} --out {{}}/x" for output in ("csv", "layout", "mp4", "rosbag2"))
RECORDING = ("view {}", "report {}", *EXPORTS)
ALONE = (*TABLE, *RECORDING)
NUMBERS = ("report {}", "replay {} --out {}/x")
SCENARIO = (*NUMBERS, "view {}", FRAME, "radio {} --coverage car1 --out {}/x.png")


def recording_of(chunks: Callable[[], Iterable[bytes]], vehicles: str = "car1 car2") -> Make:
    return lambda folder: bombs.recording(folder / "run.mcap", iter(chunks()), vehicles)


def state(time_ns: int, x_m: float = 0.0) -> Iterator[bytes]:
    """One state of car1 at ``time_ns``."""
    still = b'"velocity":[0,0,0],"attitude":[1,0,0,0],"angular_velocity":[0,0,0]'
    position = f'{{"type":"state","position":[{x_m},0,0],'.encode()
    yield bombs.head("car1/state", "vcmvsp.VehicleState") + bombs.message(position + still + b"}", time_ns)


def empty_drawing() -> Iterator[bytes]:
    """A world with a body without triangles."""
    body = b'"id":"x","lifetime":{},"frame_locked":false,"timestamp":{"sec":0,"nsec":0},"frame_id":"world"'
    triangles = b'"triangles":[{"pose":{},"points":[],"color":{"r":0,"g":0,"b":0,"a":1},"indices":[]}]'
    return bombs.one("world/solids", "foxglove.SceneUpdate", b'{"entities":[{' + body + b"," + triangles + b"}]}")


def names() -> Iterator[bytes]:
    """Notes of a thousand names each, all different: a table of 300 million cells."""
    notes = ("{" + ",".join(f'"{row}_{name}":1' for name in range(1000)) + "}" for row in range(550))
    yield bombs.head("car1/note", "vcmvsp.Note") + b"".join(bombs.message(f'{{"values":{each}}}'.encode()) for each in notes)


IN_RESULTS: dict[str, tuple[Make, tuple[str, ...]]] = {
    "radio rows": (lambda folder: bombs.rows(folder / "radio.parquet", folder / "radio.parquet"), RADIO),
    "state rows": (lambda folder: bombs.rows(folder / "states.parquet", folder / "states.parquet"), TABLE),
    "long word": (lambda folder: bombs.long_text(folder / "radio.parquet", folder / "radio.parquet"), RADIO),
    "long messages": (recording_of(bombs.zeros), ALONE),
    "large chunk": (recording_of(lambda: bombs.zeros(part=1_000_000_000)), RECORDING),
    "many messages": (recording_of(bombs.many), ALONE),
    "many names": (recording_of(names), RECORDING),
    "many vehicles": (recording_of(lambda: state(0), " ".join(f"car{k}" for k in range(100_000))), RECORDING),
    "late message": (recording_of(lambda: state(2**64 - 1)), ALONE),
    "last second": (recording_of(lambda: state(2**62)), ("export {} --rosbag2 --out {}/x",)),
    "far away": (recording_of(lambda: [*state(0, -1.7e308), *state(0, 1.7e308)]), EXPORTS),
    "no number": (lambda folder: bombs.recording(folder / "run.mcap", state(0), "car1", seed="x"), EXPORTS[:1]),
    "no vehicle": (recording_of(lambda: bombs.one("else/scan", "foxglove.LaserScan", b"{}")), EXPORTS[1:2]),
    "no triangles": (recording_of(lambda: [*state(0), *empty_drawing()]), ("export {} --mp4 --out {}/x",)),
    "deep note": (recording_of(lambda: bombs.one("car1/note", "vcmvsp.Note", b'{"values":' + TREE)), RECORDING),
    "deep line": (recording_of(lambda: bombs.one("log", "foxglove.Log", b'{"x":' + TREE)), RECORDING),
    "deep frame": (recording_of(lambda: bombs.one("radio/frame", "vcmvsp.Frame", b'{"x":' + TREE)), ALONE),
    "empty note": (recording_of(lambda: bombs.one("car1/note", "vcmvsp.Note", b"")), RECORDING),
    "empty frame": (recording_of(lambda: bombs.one("radio/frame", "vcmvsp.Frame", b"")), ALONE),
    "no text": (recording_of(lambda: bombs.one("car1/else", "x", b"\xff")), ("export {} --rosbag2 --out {}/x",)),
    "deep metrics": (lambda folder: (folder / "metrics.json").write_bytes(TREE), NUMBERS),
    "deep about": (lambda folder: (folder / "about.json").write_bytes(TREE), NUMBERS),
    "deep scenario": (lambda folder: (folder / "scenario.toml").write_bytes(b"a = " + TREE), SCENARIO),
    "long metrics": (lambda folder: bombs.sparse(folder / "metrics.json"), NUMBERS),
    "long about": (lambda folder: bombs.sparse(folder / "about.json"), NUMBERS),
    "long scenario": (lambda folder: bombs.sparse(folder / "scenario.toml"), SCENARIO),
}
"""Damage to the folder of a run, and the commands that read it. `ALONE`: without tables, as of a killed run."""
CASES = [(name, reader) for name, (_, readers) in IN_RESULTS.items() for reader in readers]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], CommandCost]:
    """Output and costs of each reader for each folder."""
    runs = tmp_path_factory.mktemp("runs")
    (runs / "s.toml").write_text(two_cars())
    vcmvsp.run(runs / "s.toml", out=runs / "run", set={"duration_s": 1.0})
    commands = []
    for number, (make, readers) in enumerate(IN_RESULTS.values()):
        folder = Path(shutil.copytree(runs / "run", runs / str(number)))
        make(folder)
        for path in folder.glob("*.parquet") if readers is ALONE else ():
            path.unlink()
        commands += [reader.replace("{}", str(folder)) for reader in readers]
    return dict(zip(CASES, measure_commands(commands), strict=True))


@pytest.mark.parametrize(("name", "reader"), CASES)
def test_results_are_read_or_refused_at_little_cost(
    name: str, reader: str, answers: dict[tuple[str, str], CommandCost]
) -> None:
    assert_answered(answers[name, reader])
