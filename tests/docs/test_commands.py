"""Every command of a README is run by a test, or is listed with the reason why it cannot be."""

import ast
import re
import shlex
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.docs.gallery import section
from tests.support.docs.readme_coverage import ELSEWHERE, SHOWN, UNRUN
from tests.support.docs.readme_pages import (
    COMMANDS,
    MENTIONS,
    Command,
    check_mention,
    our_words,
    parse_command,
    program_of,
    words_of,
)
from tests.support.docs.readme_sessions import STORIES, Step, Story
from tests.support.paths import ROOT
from vcmvsp.cosim.scenario import loader

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

STEPS = {step.command for story in STORIES for step in story.steps}
KNOWN = [each for each in COMMANDS if program_of(words_of(each.text)) in {"vcmvsp", "make"}]
DO = (
    "A command in a README is run by a test. Make it a `Step` in tests/support/docs/readme_sessions.py; or, if a test runs it"
    " already, name that in ELSEWHERE, or, if it cannot be run here, say why in UNRUN (tests/support/docs/readme_coverage.py)."
)


@cache
def defined_in(file: str) -> set[str]:
    """Names of the functions in a file; none if there is no such file."""
    path = ROOT / file
    nodes = ast.walk(ast.parse(path.read_text("utf-8"))) if path.is_file() else iter(())
    return {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def changes() -> list[tuple[str, list[str]]]:
    """Scenarios, and settings that the gallery, or a sentence of a page, offers for them."""
    settings = [(name, shlex.split(span)) for name in loader.names() for span in re.findall(r"`(--set [^`]+)`", section(name))]
    for mention in MENTIONS:
        words = words_of(mention.partition(": ")[2])
        for option, value in pairwise(words):
            if option in {"--set", "--vary"} and words[2] in loader.names():
                settings.append((words[2], ["--set", re.split("[,:]", value)[0]]))
    return settings


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_every_command_is_listed(command: Command) -> None:
    lists = [each for each in (STEPS, ELSEWHERE, UNRUN) if command.text in each]
    assert lists, f"{command}\nis in no list. {DO}"
    assert len(lists) == 1 or UNRUN not in lists, f"{command}\nis run, and said to be one that cannot be"


@pytest.mark.parametrize("command", KNOWN, ids=str)
def test_every_command_is_valid(command: Command) -> None:
    words = words_of(command.text.partition(" > ")[0])
    if program_of(words) == "vcmvsp":
        parse_command(our_words(words))
    else:
        check_mention(words)


@pytest.mark.parametrize("mention", MENTIONS)
def test_commands_in_sentences_are_valid(mention: str) -> None:
    check_mention(mention.partition(": ")[2].split())


@pytest.mark.parametrize(("name", "settings"), changes())
def test_every_setting_offered_is_valid_in_its_scenario(name: str, settings: list[str]) -> None:
    code, _, err = vcmvsp_command("check", name, *settings)
    assert code == 0, err


def test_listed_commands_are_still_in_a_readme() -> None:
    shown = {each.text for each in COMMANDS} | {each.partition(": ")[2] for each in MENTIONS}
    assert [each for each in (*STEPS, *ELSEWHERE, *UNRUN) if each not in shown] == []


@pytest.mark.parametrize("test", sorted({each for each in (*ELSEWHERE.values(), *SHOWN.values()) if "::" in each}))
def test_listed_tests_exist(test: str) -> None:
    file, _, name = test.partition("::")
    assert name in defined_in(file), f"there is no {test}: another test must run what it ran. {DO}"


@pytest.mark.parametrize("story", STORIES, ids=lambda story: story.name)
def test_commands_run_and_write_their_files(story: Story, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in story.files.items():
        (tmp_path / name).write_text(text)
    for step in story.steps:
        run_step(step)


def run_step(step: Step) -> None:
    """Run a step here: it succeeds and writes its files."""
    command, _, target = step.command.partition(" > ")
    words = [step.instead.get(word, word) for word in our_words(words_of(command))] + shlex.split(step.shorter)
    code, out, err = vcmvsp_command(*words)
    assert code == 0, f"{step.command}\n{err}"
    if target:
        Path(target).write_text(out)
    for option, name in pairwise(words):
        if option in {"--out", "--png"}:
            assert Path(name).exists(), f"{step.command} wrote no {name}"
