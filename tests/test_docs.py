"""The reference of scenario keys and the gallery say what the software does."""

import re
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim import progress, reference, registry, scenario, table
from netsim.jammer import Source
from netsim.materials import ITU_MATERIALS
from netsim.script import Change
from physics.world import Box

FOLDER = Path(__file__).parent.parent / "scenarios"
TEXT = (FOLDER / "README.md").read_text("utf-8")
Documented = dict[str, dict[str, str]]  # column of defaults -> key -> what it says


def tables() -> dict[str, list[Documented]]:
    """Every table of keys, by the heading that it stands under."""
    found: dict[str, list[Documented]] = {}
    heading, columns = "", []
    for line in TEXT.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if line.startswith("#"):
            heading = line.strip("# ")
        elif cells and cells[0] == "key":
            columns = cells[2:-1]
            found.setdefault(heading, []).append({name: {} for column in columns for name in column.split(", ")})
        elif cells and columns and not line.startswith("|---"):
            for column, says in zip(columns, cells[2:-1], strict=True):
                for name in column.split(", "):
                    if says != "–":  # this kind takes no such key
                        found[heading][-1][name][cells[0].strip("`")] = says
        elif not cells:
            columns = []
    return found


TABLES = tables()
HEADINGS = {
    "physics": ("`[physics]`",),
    "world": ("`[world]`",),
    "vehicle": ("Vehicles that are points", "Robots with two driven wheels and a caster"),
    "agent": ("Leaders", "Followers"),
    **{layer: (f"`[radio.{layer}]`",) for layer in registry.piece("radio presets").LAYERS},
}
FROM_ELSEWHERE = {"world", "vehicles", *reference.OFFERED}  # parameters that come from the rest of the scenario


def by_kind(*headings: str) -> dict[str, dict[str, str]]:
    return {name: keys for heading in headings for one in TABLES[heading] for name, keys in one.items()}


def assert_documents(documented: dict[str, str], target: Any, without: set[str]) -> None:
    """Every key once, ``required`` where it is, and the default as TOML where TOML can say it."""
    wanted = {name: each for name, each in table.parameters(target).items() if name not in without}
    assert set(documented) == set(wanted)
    for name, parameter in wanted.items():
        says = documented[name]
        assert (says == "required") == parameter.required, name
        default = table.plain(parameter.default)
        if says.startswith("`") and not isinstance(default, dict):
            assert scenario.value_of(says.strip("`")) == default, name
        elif not parameter.required:
            assert default is None or isinstance(default, dict), f"{name}: its default is {default}"


@pytest.mark.parametrize(
    ("heading", "target", "rest"),
    [
        ("Top level", scenario.Scenario, ""),
        ("`[agents]`", scenario.AgentsTable, "defaults"),
        ("`[[vehicle]]` and `[vehicles]`", scenario.VehicleTable, "params"),
        ("`agent = { ... }` of a vehicle", scenario.AgentTable, "params"),
        ("`[record]`", scenario.RecordTable, ""),
        ("`[metrics]`", scenario.MetricsTable, ""),
    ],
)
def test_every_key_of_a_table_is_documented(heading: str, target: Any, rest: str) -> None:
    (documented,) = TABLES[heading]
    assert_documents(documented["default"], target, {rest})


@pytest.mark.parametrize(("group", "kind"), [(group, kind) for group, kinds in registry.KINDS.items() for kind in kinds])
def test_every_kind_is_documented_with_all_its_parameters(group: str, kind: str) -> None:
    target = registry.find(group, kind)
    if set(table.parameters(target)) - FROM_ELSEWHERE:
        assert_documents(by_kind(*HEADINGS[group])[kind], target, FROM_ELSEWHERE)
    else:
        assert f"\n- `{kind}`: " in TEXT.partition(f"# {HEADINGS[group][0]}\n")[2].partition("\n#")[0]


@pytest.mark.parametrize(
    ("heading", "item", "target"),
    [
        ("`[world]`", "box", Box),
        ("`positioning = { ... }`", "positioning", registry.piece("positioning")),
        ("`radio = { ... }`", "default", registry.piece("vehicle radio")),
        ("`[radio.script]`", "change", Change),
        ("`[radio.jammer]`", "source", Source),
    ],
)
def test_what_lists_and_vehicles_hold_is_documented(heading: str, item: str, target: Any) -> None:
    assert_documents(by_kind(heading)[item], target, set())


def test_every_preset_is_documented() -> None:
    rows = [line.split("`")[1] for line in TEXT.splitlines() if re.match(r"\| `[a-z0-9.-]+` \| `(none|log_distance)`", line)]
    assert rows == list(registry.piece("radio presets").PRESETS)


def test_materials_are_those_that_walls_are_made_of() -> None:
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `material` |")]
    assert re.findall(r"`(\w+)`", row.rpartition("`itu`")[2]) == list(ITU_MATERIALS)


@pytest.mark.parametrize("name", scenario.names())
def test_a_built_in_scenario_prints_what_its_gallery_says(name: str) -> None:
    section = TEXT.partition(f"### {name}\n")[2].partition("\n## ")[0].partition("\n### ")[0]
    shown = section.partition("```\n")[2].partition("```")[0]
    result = cosim.run(name)
    assert shown.splitlines() == progress.summary(result).splitlines()[1:3]
    (other,) = re.findall(r"`--set agents.estimator=(\w+)`", section)
    (rms,) = re.findall(r"(0\.\d{4}) m\s+RMS", section.rpartition("With `--set")[2])
    changed = cosim.run(name, set={"agents.estimator": other})
    assert changed.metrics["formation"]["rms_m"] == pytest.approx(float(rms), abs=5e-5)


@pytest.mark.parametrize("name", scenario.names())
def test_a_built_in_scenario_says_in_one_line_what_it_shows(name: str) -> None:
    assert 30 < len(scenario.first_words(name)) < 100


def test_pictures_are_there_and_small() -> None:
    linked = set(re.findall(r"\]\((pictures/[^)]+)\)", TEXT))
    assert linked == {f"pictures/{path.name}" for path in (FOLDER / "pictures").iterdir()}
    assert all((FOLDER / name).stat().st_size < 80_000 for name in linked)
