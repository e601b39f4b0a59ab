"""Every file that a user gives is read, or refused in one line, in a few seconds and a gigabyte, however much it unpacks to."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim import unpacking_bombs as bombs
from tests.support.cosim.command_line import two_cars
from tests.support.cosim.measured_commands import Measured, answered, measured
from tests.support.cosim.unpacking_bombs import DEEP, sparse

Make = Callable[[Path], object]
TREE = "[" * DEEP
REAL = two_cars(car1='driver = { kind = "bench" }')


def text(name: str, content: str) -> Make:
    """A file of this content."""
    return lambda folder: (folder / name).write_text(content)


def zeros(name: str, head: str = "") -> Make:
    """Ten gigabytes behind this beginning."""

    def make(folder: Path) -> None:
        sparse(folder / name)
        with (folder / name).open("r+") as stream:
            stream.write(head)

    return make


def scenario(tail: str, make: Make, command: str = "check {}/s.toml") -> tuple[str, Make]:
    """A scenario that ends with these tables, and a file for it."""

    def both(folder: Path) -> None:
        (folder / "s.toml").write_text(two_cars(tail=tail))
        make(folder)

    return command, both


def replayed(make: Make) -> tuple[str, Make]:
    """A run with a real vehicle, and what came into it from outside."""

    def both(folder: Path) -> None:
        (folder / "scenario.toml").write_text(REAL)
        make(folder)

    return "replay {} --out {}/again", both


def inputs(chunks: Callable[[], object]) -> tuple[str, Make]:
    return replayed(lambda folder: bombs.recording(folder / "hardware.mcap", chunks(), "car1 car2"))  # type: ignore[arg-type]


GIVEN: dict[str, tuple[str, Make]] = {
    "scenario long": ("check {}/s.toml", zeros("s.toml")),
    "scenario deep": ("check {}/s.toml", text("s.toml", f"a = {TREE}")),
    "scenario of dots": ("check {}/s.toml", text("s.toml", "a" + ".a" * DEEP + " = 1")),
    "hosts long": scenario("", zeros("hosts.toml"), "launch {}/s.toml --hosts {}/hosts.toml"),
    "hosts deep": scenario("", text("hosts.toml", f"a = {TREE}"), "launch {}/s.toml --hosts {}/hosts.toml"),
    "keys long": ("agent --connect tcp/127.0.0.1:1 --vehicle car1 --keys {}/car1.pem", zeros("car1.pem")),
    "keys index deep": ("keys list --keys {}", text("index.json", TREE)),
    "keys index long": ("keys list --keys {}", zeros("index.json")),
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
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Measured]:
    """What the commands say to each."""
    top = tmp_path_factory.mktemp("given")
    (top / "s.toml").write_text(two_cars())
    vcmvsp.run(top / "s.toml", out=top / "run", set={"duration_s": 1.0})
    vcmvsp.study(top / "s.toml", vary={"duration_s": [0.2, 0.3]}, seeds=1, jobs=1, out=top / "study")
    asked = {}
    for name, (command, make) in GIVEN.items():
        folder = top / name.replace(" ", "-")
        folder.mkdir()
        make(folder)
        asked[name] = command.replace("{}", str(folder))
    for name, make in IN_STUDY.items():
        for reader in STUDY_READERS:
            folder = Path(shutil.copytree(top / "study", top / f"{reader[:5].strip()}-{name.replace(' ', '-')}"))
            make(folder)
            asked[f"{reader.split()[0]} {name}"] = reader.replace("{}", str(folder))
    return dict(zip(asked, measured(list(asked.values())), strict=True))


@pytest.mark.parametrize("name", [*GIVEN, *(f"{reader.split()[0]} {name}" for name in IN_STUDY for reader in STUDY_READERS)])
def test_what_is_given_is_read_or_refused_at_little_cost(name: str, answers: dict[str, Measured]) -> None:
    answered(answers[name])
