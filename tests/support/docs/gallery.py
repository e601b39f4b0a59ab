"""Runs of the gallery of built-in scenarios, and their printed output."""

import re
from functools import cache

import pytest

import vcmvsp
from tests.support.paths import SCENARIOS
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.terminal import progress

FOLDER = SCENARIOS
TEXT = (FOLDER / "README.md").read_text("utf-8")


def section(name: str) -> str:
    return TEXT.partition(f"### {name}\n")[2].partition("\n## ")[0].partition("\n### ")[0]


@cache
def gallery_scenario(name: str) -> vcmvsp.Result:
    """A built-in scenario as by its command, without what differs from run to run."""
    command = rf"(?:^ {{4}}|\(`)vcmvsp run {name}((?: --set [\w.=]+)*)(?:$|`)"  # in a block, or in brackets
    (changed,) = re.findall(command, section(name), re.MULTILINE) or [""]
    settings = loader.settings_of(changed.split()[1::2])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VCMVSP_COMPILED", "1")  # pays for quadrotors, also with the compilation
        return vcmvsp.run(name, set={**loader.load(name)[0].twins, **settings}, agents="inprocess", mcap=False)


def assert_printed(name: str) -> None:
    """Assert that a scenario prints the lines of its gallery entry."""
    shown = section(name).partition("```\n")[2].partition("```")[0].splitlines()
    result = gallery_scenario(name)
    assert shown == progress.summary(result).splitlines()[1 : 1 + len(shown)]
    assert not result.metrics["radio"]["frames"] or shown[0].startswith("radio: ")  # a lone vehicle has no receivers
