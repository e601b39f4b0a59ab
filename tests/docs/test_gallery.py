"""The gallery of built-in scenarios shows their output, and the effect of changed keys."""

import re

import pytest

import vcmvsp
from tests.support.docs.gallery import FOLDER, TEXT, assert_printed, gallery_scenario, section
from vcmvsp.cosim.scenario import loader

pytestmark = pytest.mark.processes

SEARCHING = "recon-"  # prefix; slow, in `tests/agents/reconnaissance/test_gallery.py`


@pytest.mark.parametrize("name", [name for name in loader.names() if not name.startswith(SEARCHING)])
def test_a_built_in_scenario_prints_its_gallery_text(name: str) -> None:
    assert_printed(name)


@pytest.mark.parametrize("name", [name for name in loader.names() if name.startswith("formation-")])
def test_a_formation_with_another_estimator_has_the_error_in_the_gallery(name: str) -> None:
    (other,) = re.findall(r"`--set agents.estimator=(\w+)`", section(name))
    (rms,) = re.findall(r"(0\.\d{4}) m\s+RMS", section(name).rpartition("With `--set")[2])
    changed = vcmvsp.run(name, set={"agents.estimator": other}, agents="inprocess", mcap=False)
    assert changed.metrics["formation"]["rms_m"] == pytest.approx(float(rms), abs=5e-5)


def test_robots_on_patrol_collide_only_with_the_clearance_in_the_gallery() -> None:
    assert gallery_scenario("lab-patrol").metrics["safety"]["collisions"] == 0
    (clearance,) = re.findall(r"`--set agents.clearance=(\S+)` they collide", section("lab-patrol"))
    bumping = vcmvsp.run("lab-patrol", set={"agents.clearance": float(clearance), "duration_s": 25.0}, mcap=False)
    assert bumping.metrics["safety"]["collisions"] > 0


@pytest.mark.parametrize("name", loader.names())
def test_a_built_in_scenario_has_a_description_of_one_line(name: str) -> None:
    assert 30 < len(loader.first_words(name)) < 100


def test_pictures_exist_and_are_small() -> None:
    linked = set(re.findall(r"\]\((pictures/[^)]+)\)", TEXT))
    assert linked == {f"pictures/{path.name}" for path in (FOLDER / "pictures").iterdir()}
    assert all((FOLDER / name).stat().st_size < 100_000 for name in linked)
