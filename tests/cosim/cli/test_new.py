"""``vcmvsp new``: the written files run and pass their own test unedited; names that cannot be used are refused."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.cosim.command_line import answer_of, assert_refused, contents, vcmvsp_command
from tests.support.paths import ROOT
from vcmvsp.cosim.cli import kinds

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("here")]

OWN = [part for part in kinds.PARTS if part != "scenario"]


def python(*arguments: str) -> str:
    """Output of Python with the checkout on its path; it must exit with 0."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    process = subprocess.run(command, check=False, capture_output=True, text=True, timeout=140, env=environment)
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_all_parts_run_and_pass_their_own_tests_unedited(here: Path) -> None:
    tests = []
    for part in kinds.PARTS:
        printed = vcmvsp_command("new", part, f"my-own-{part}").out
        run, test = re.search(r"next: vcmvsp (run \S+)\n +pytest (\S+)\n", printed).groups()  # type: ignore[union-attr]
        assert vcmvsp_command(*run.split(), "--set", "duration_s=2", "--quiet", "--out", part).code == 0
        assert (here / part / "metrics.json").is_file()
        tests.append(test)
    passed = python("-m", "pytest", "-v", "-p", "no:cacheprovider", *tests)  # one process: most of its time are imports
    assert {*re.findall(r"^(\S+)::\S+ PASSED", passed, re.MULTILINE)} == {*tests}
    assert not re.search("failed|skipped|warning", passed)


@pytest.mark.parametrize("part", kinds.PARTS)
def test_it_lists_the_written_files(here: Path, part: str) -> None:
    out = answer_of("new", part, "thing", "--out", "some/where")
    written = {str(path.relative_to(here)) for path in (here / "some" / "where").iterdir()}
    assert {line.split()[0] for line in out.partition("next: ")[0].splitlines()} == written
    assert "vcmvsp reference --json-schema > some/where/scenario.schema.json" in out
    assert (here / "some" / "where" / "thing.toml").read_text().startswith("#:schema ./scenario.schema.json\n")
    assert written == {f"some/where/{name}" for name in ("thing.py", "thing.toml", "test_thing.py")[part == "scenario" :]}


@pytest.mark.parametrize("name", ["follow-wall", "follow_wall", "FollowWall", "followWall"])
def test_one_name_in_any_spelling_gives_one_module_and_one_class(here: Path, name: str) -> None:
    assert vcmvsp_command("new", "agent", name).code == 0
    assert sorted(path.name for path in here.iterdir()) == ["follow_wall.py", "follow_wall.toml", "test_follow_wall.py"]
    assert "class FollowWall(Agent):" in (here / "follow_wall.py").read_text()
    assert tomllib.loads((here / "follow_wall.toml").read_text())["agents"]["kind"] == "follow_wall.py:FollowWall"


@pytest.mark.parametrize("part", kinds.PARTS)
def test_nothing_of_the_template_is_left_over(part: str) -> None:
    texts = kinds.rendered(part, "some_thing", "SomeThing")
    assert not any("$" in text or "\t" in text for text in texts.values())
    assert max(len(line) for text in texts.values() for line in text.splitlines()) <= 128


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("planet", "mars"), "unknown part 'planet'"),
        (("agnet", "mine"), "did you mean 'agent'?"),
        (("agent", "3d"), "a name starts with a letter"),
        (("agent", "my agent"), "a name starts with a letter"),
        (("agent", "schön"), "a name starts with a letter"),
        (("agent", "mine.py"), "a name starts with a letter"),
        (("agent", ""), "a name starts with a letter"),
        (("agent", "a" * 61), "60 at most"),
        (("agent", "sub/mine"), "is a path; give only a name, and the folder with --out DIR"),
        (("agent", ".."), "a name starts with a letter"),
        (("agent", "sub\\mine"), "is a path"),
        (("agent", "class"), "is a keyword of Python"),
        (("agent", "none"), "is a keyword of Python"),
        (("agent", "leader-follower"), "a built-in agent has this name"),
        (("vehicle", "urdf_quadrotor"), "a built-in vehicle has this name"),
        (("channel", "Rayleigh"), "a built-in channel has this name"),
        (("channel", "gudmundson"), "a built-in channel has this name"),
        (("sensor", "lms"), "a built-in sensor has this name"),
        (("driver", "ros2"), "a built-in driver has this name"),
        (("scenario", "formation-circle"), "a built-in scenario has this name"),
        (("channel", "received"), "losses with this cause would count as received"),
        (("agent", "random"), "random.py would hide a module"),
        (("sensor", "numpy"), "numpy.py would hide a module"),
        (("agent", "velocity"), "the template already uses 'Velocity'"),
        (("driver", "loopback"), "the template already uses 'Loopback'"),
        (("agent", "mine", "--out", "a-file"), "--out a-file: is a file, not a folder"),
        (("agent", "mine", "--out", "a-file/below"), "cannot write into a-file/below"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line_and_nothing_is_written(
    here: Path, arguments: tuple[str, ...], words: str
) -> None:
    (here / "a-file").write_text("mine")
    assert_refused(vcmvsp_command("new", *arguments), words)
    assert [path.name for path in here.iterdir()] == ["a-file"]


@pytest.mark.parametrize("taken", ["mine.py", "mine.toml", "test_mine.py"])
def test_an_existing_file_stays_and_nothing_is_written_beside_it(here: Path, taken: str) -> None:
    (here / taken).symlink_to("nowhere")  # a dangling link, too: writing would create its target
    assert vcmvsp_command("new", "agent", "mine").code == 2
    (here / taken).unlink()
    (here / taken).write_text("my own")
    before = contents(here)
    assert_refused(vcmvsp_command("new", "agent", "mine"), f"{taken}: already exists")
    assert contents(here) == before


@pytest.mark.parametrize("part", OWN)
def test_the_written_kind_is_shown_with_its_parameters(here: Path, part: str) -> None:
    vcmvsp_command("new", part, "mine")
    if part not in ("channel", "task"):  # `show` has no groups for layers and tasks
        assert answer_of("show", part, "mine.py:Mine").startswith("mine.py:Mine: ")
    assert vcmvsp_command("check", "mine.toml").code == 0
