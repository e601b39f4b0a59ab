"""Files are whole or absent, with every command that writes them."""

import math
import os
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import Outcome, vcmvsp_command
from tests.support.cosim.full_disk import room_for
from tests.support.cosim.studies import LOSS, two
from vcmvsp.cosim.util.files import PART, replacing, write_whole

pytestmark = pytest.mark.processes

ROOM = 60  # bytes


COMMANDS = {
    "plot": "plot {run} --out {out}",
    "plot as SVG": "plot {run} --svg --out {out}",
    "report": "report {run} --out {out}/report.html",
    "coverage": "radio formation-circle --coverage car1 --resolution 2 --out {out}/map.png",
    "world": "world corridor --png {out}/world.png",
    "calibrate": "calibrate {run}/links.csv --out {out}",
    "export": "export {run} --csv --layout --force --out {out}",
}


def write_with(command: str, run: Path, out: Path) -> Outcome:
    """The outcome of a command that writes into a folder."""
    return vcmvsp_command(*COMMANDS[command].format(run=run, out=out).split())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    vcmvsp.run(two(duration_s=1.0), out=folder)
    rows = "".join(f"{d},0,0,1,{d},0,1,{-40 - 20 * math.log10(d) + d % 3}\n" for d in range(1, 80))
    (folder / "links.csv").write_text(f"time,ax,ay,az,bx,by,bz,rssi_dbm\n{rows}")
    return folder


@pytest.mark.usefixtures("figures")
@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "export"])
def test_a_full_disk_is_one_error_and_keeps_earlier_files(command: str, run: Path, tmp_path: Path) -> None:
    whole, out = tmp_path / "whole", tmp_path / "out"
    for folder in (whole, out):
        folder.mkdir()
    assert write_with(command, run, whole).code == 0
    names = sorted(path.name for path in whole.iterdir())
    assert names
    for name in names:
        (out / name).write_bytes(b"of before")
    with room_for(ROOM):
        outcome = write_with(command, run, out)
    assert outcome.code == 2
    assert outcome.err.count("File too large") == outcome.err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in out.iterdir()} == dict.fromkeys(names, b"of before")


@pytest.mark.usefixtures("figures")
def test_a_full_disk_keeps_the_files_of_a_study(tmp_path: Path) -> None:
    out = tmp_path / "study"
    vcmvsp.study(two(), vary={LOSS: [0.0, 0.5]}, seeds=1, metrics=["formation.rms_m"], jobs=1, out=out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with room_for(len(before["report.html"]) // 2):
        outcome = vcmvsp_command("report", str(out))
    assert (outcome.code, outcome.err) == (2, f"vcmvsp: cannot write into {out}: File too large\n")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_failing_keeps_the_earlier_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("of before")

    def fail() -> None:
        with replacing(path) as place:
            place.write_text("half of")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [each.name for each in tmp_path.iterdir()] == ["file.txt"]
    assert path.read_text() == "of before"


def test_files_of_a_killed_process_do_not_disturb(tmp_path: Path) -> None:
    left = tmp_path / f".vcmvsp-left{PART}"
    left.mkdir()
    write_whole(tmp_path / "file.txt", "all of it")
    assert {*tmp_path.iterdir()} == {left, tmp_path / "file.txt"}
    assert (tmp_path / "file.txt").read_text() == "all of it"


def test_links_are_replaced_and_pipes_are_written_to(tmp_path: Path) -> None:
    (tmp_path / "file.txt").write_text("somebody else's")
    (tmp_path / "link").symlink_to(tmp_path / "file.txt")
    (tmp_path / "dangling").symlink_to(tmp_path / "none.txt")
    for name in ("link", "dangling"):
        write_whole(tmp_path / name, "ours")
        assert not (tmp_path / name).is_symlink()
        assert (tmp_path / name).read_text() == "ours"
    assert (tmp_path / "file.txt").read_text() == "somebody else's"
    assert not (tmp_path / "none.txt").exists()
    reading, writing = os.pipe()
    write_whole(Path(f"/dev/fd/{writing}"), "into it")
    os.close(writing)
    with open(reading) as pipe:  # noqa: PTH123
        assert pipe.read() == "into it"


def test_the_folder_of_a_file_being_written_is_private(tmp_path: Path) -> None:
    places = []
    for _ in range(2):
        with replacing(tmp_path / "file.txt") as place:
            assert (place.parent.parent, place.parent.stat().st_mode & 0o777) == (tmp_path, 0o700)
            place.touch()
            places.append(place)
    assert places[0] != places[1]


@pytest.mark.usefixtures("figures")
@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "calibrate"])
def test_a_command_replaces_links_in_a_folder_that_may_be_a_link(command: str, run: Path, tmp_path: Path) -> None:
    real, out, victim = tmp_path / "real", tmp_path / "out", tmp_path / "victim"
    real.mkdir()
    out.symlink_to(real)
    assert write_with(command, run, out).code == 0
    assert out.is_symlink()
    files = [path for path in real.rglob("*") if path.is_file()]
    assert files
    victim.write_text("somebody else's")
    for path in files:
        path.unlink()
        path.symlink_to(victim)
    assert write_with(command, run, out).code == 0
    assert victim.read_text() == "somebody else's"
    assert not any(path.is_symlink() for path in files)


def test_a_run_replaces_links_too(tmp_path: Path) -> None:
    out, victim = tmp_path / "out", tmp_path / "victim"
    vcmvsp.run(two(duration_s=1.0), out=out)
    victim.write_text("somebody else's")
    for path in out.iterdir():
        path.unlink()
        path.symlink_to(victim)
    vcmvsp.run(two(duration_s=1.0), out=out, force=True)
    assert victim.read_text() == "somebody else's"
    assert not any(path.is_symlink() for path in out.iterdir())
