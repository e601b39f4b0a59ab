"""Every input file, however large it unpacks, is read or refused in one line, within a few seconds and a gigabyte."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim import unpacking_bombs as bombs
from tests.support.cosim.command_line import two_cars
from tests.support.cosim.measured_commands import CommandCost, assert_answered, measure_commands
from tests.support.cosim.unpacking_bombs import DEEP, sparse

pytestmark = pytest.mark.processes

Make = Callable[[Path], object]
TREE = "[" * DEEP
REAL = two_cars(car1='driver = { kind = "bench" }')


def text(name: str, content: str) -> Make:
    """Writes a file with this content."""
    return lambda folder: (folder / name).write_text(content)


def zeros(name: str, head: str = "") -> Make:
    """Writes a file of ten gigabytes of zeros that begins with ``head``."""

    def make(folder: Path) -> None:
        sparse(folder / name)
        with (folder / name).open("r+") as stream:
            stream.write(head)

    return make


def both_of(one: Make, other: Make) -> Make:
    """Writes two files."""
    return lambda folder: (one(folder), other(folder))


def world(kind: str, path: str, make: Make) -> tuple[str, Make]:
    """A scenario whose world is read from a file."""
    return scenario(f'[world]\nkind = "{kind}"\npath = "{path}"\n', make)


def vehicle(make: Make) -> tuple[str, Make]:
    """A scenario with a vehicle from a URDF file."""
    kind = '"urdf"\nfile = "r.urdf"\nleft_wheel = "l"\nright_wheel = "r"'
    return "check {}/s.toml", both_of(text("s.toml", two_cars().replace('"p2dx"', kind)), make)


def stl(folder: Path) -> None:
    """A mesh whose header claims two thousand million triangles; it contains one."""
    (folder / "m.stl").write_bytes(bytes(80) + struct.pack("<I", 2_000_000_000) + bytes(50))


def scenario(tail: str, make: Make, command: str = "check {}/s.toml") -> tuple[str, Make]:
    """A command, and a writer of its scenario (two cars and the tables ``tail``) and of another file."""

    def both(folder: Path) -> None:
        (folder / "s.toml").write_text(two_cars(tail=tail))
        make(folder)

    return command, both


def replayed(make: Make) -> tuple[str, Make]:
    """Replay of a run with a real vehicle, whose recorded inputs are written by ``make``."""

    def both(folder: Path) -> None:
        (folder / "scenario.toml").write_text(REAL)
        make(folder)

    return "replay {} --out {}/again", both


def inputs(chunks: Callable[[], object]) -> tuple[str, Make]:
    return replayed(lambda folder: bombs.recording(folder / "hardware.mcap", chunks(), "car1 car2"))  # type: ignore[arg-type]


GRID = "image: map.png\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
TRACED = '[radio]\npreset = "wifi-g-6"\ntrace = { kind = "trace", file = "t.csv" }\n'
GIVEN: dict[str, tuple[str, Make]] = {
    "scenario long": ("check {}/s.toml", zeros("s.toml")),
    "scenario deep": ("check {}/s.toml", text("s.toml", f"a = {TREE}")),
    "scenario of dots": ("check {}/s.toml", text("s.toml", "a" + ".a" * DEEP + " = 1")),
    "hosts long": scenario("", zeros("hosts.toml"), "launch {}/s.toml --hosts {}/hosts.toml"),
    "hosts deep": scenario("", text("hosts.toml", f"a = {TREE}"), "launch {}/s.toml --hosts {}/hosts.toml"),
    "keys long": ("agent --connect tcp/127.0.0.1:1 --vehicle car1 --keys {}/car1.pem", zeros("car1.pem")),
    "keys index deep": ("keys list --keys {}", text("index.json", TREE)),
    "keys index long": ("keys list --keys {}", zeros("index.json")),
    "world file long": world("file", "w.toml", zeros("w.toml")),
    "world file deep": world("file", "w.toml", text("w.toml", f"a = {TREE}")),
    "map long": world("map", "map.yaml", zeros("map.yaml")),
    "map deep": world("map", "map.yaml", text("map.yaml", f"image: {TREE}")),
    "map picture": world("map", "map.yaml", both_of(text("map.yaml", GRID), lambda at: bombs.png(at / "map.png", side=11_000))),
    "map picture long": world("map", "map.yaml", both_of(text("map.yaml", GRID), zeros("map.png"))),
    "geojson long": world("geojson", "g.json", zeros("g.json")),
    "geojson deep": world("geojson", "g.json", text("g.json", TREE)),
    "mesh count": world("mesh", "m.stl", stl),
    "mesh long": world("mesh", "m.stl", zeros("m.stl")),
    "urdf deep": vehicle(text("r.urdf", "<robot name='r'>" + "<link name='a'>" * DEEP)),
    "urdf long": vehicle(zeros("r.urdf", "<robot name='r'>")),
    "trace long": scenario(TRACED, zeros("t.csv")),
    "calibrate long": ("calibrate {}/l.csv", zeros("l.csv")),
    "positions long": ("channel --preset wifi-g-6 --positions {}/p.csv --rate 1 --size 9 --duration 1", zeros("p.csv")),
    "inputs long": inputs(bombs.zeros),
    "inputs many": inputs(bombs.many),
    "inputs deep": inputs(lambda: bombs.one("car1/estimate", "vcmvsp.Pose", b"\x91" * DEEP)),
    "inputs count": inputs(lambda: bombs.one("car1/estimate", "vcmvsp.Pose", b"\xdd\xff\xff\xff\xff")),
    "inputs sparse": replayed(zeros("hardware.mcap")),
}
IN_STUDY: dict[str, Make] = {
    "plan long": zeros("study.toml"),
    "plan deep": text("study.toml", f"a = {TREE}"),
    "journal long": zeros("study.journal"),
    "journal deep": text("study.journal", TREE),
    "journal row deep": text("study.journal", '{"run":"a","row":' + TREE),
    "journal lines": text("study.journal", "\n" * 100_000_000),
}
STUDY_READERS = ("report {}", "plot {}", "study {}/../s.toml --vary duration_s=0.2,0.3 --seeds 1 --jobs 1 --resume --out {}")


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, CommandCost]:
    """Output and costs of each command."""
    top = tmp_path_factory.mktemp("given")
    (top / "s.toml").write_text(two_cars())
    vcmvsp.run(top / "s.toml", out=top / "run", set={"duration_s": 1.0})
    vcmvsp.study(top / "s.toml", vary={"duration_s": [0.2, 0.3]}, seeds=1, jobs=1, out=top / "study")
    commands = {}
    for name, (command, make) in GIVEN.items():
        folder = top / name.replace(" ", "-")
        folder.mkdir()
        make(folder)
        commands[name] = command.replace("{}", str(folder))
    for name, make in IN_STUDY.items():
        for reader in STUDY_READERS:
            folder = Path(shutil.copytree(top / "study", top / f"{reader[:5].strip()}-{name.replace(' ', '-')}"))
            make(folder)
            commands[f"{reader.split()[0]} {name}"] = reader.replace("{}", str(folder))
    return dict(zip(commands, measure_commands(list(commands.values())), strict=True))


@pytest.mark.parametrize("name", [*GIVEN, *(f"{reader.split()[0]} {name}" for name in IN_STUDY for reader in STUDY_READERS)])
def test_inputs_are_read_or_refused_at_little_cost(name: str, answers: dict[str, CommandCost]) -> None:
    assert_answered(answers[name])
