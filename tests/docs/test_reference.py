"""The reference of scenario keys agrees with the software. (`test_gallery.py` tests the gallery.)"""

import re
import typing
from typing import Any

import pytest

from tests.support.paths import ROOT
from vcmvsp.cosim.config import binding, builtin_kinds
from vcmvsp.cosim.scenario import loader, schema
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS
from vcmvsp.physics.world.solids import MATERIAL_COLORS

TEXT = "\n".join(path.read_text("utf-8") for path in sorted((ROOT / "docs" / "reference").glob("*.md")))
Documented = dict[str, dict[str, str]]  # column of defaults -> key -> text


def tables() -> dict[str, list[Documented]]:
    """All tables of keys, by heading."""
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
                    if says != "–":  # no such key of this kind
                        found[heading][-1][name][cells[0].strip("`")] = says
        elif not cells:
            columns = []
    return found


TABLES = tables()


def assert_documents(documented: dict[str, str], target: Any, without: set[str]) -> None:
    """Every key once, ``required`` if it is, and its default as TOML if it has a TOML form."""
    parameters = {name: each for name, each in binding.parameters(target).items() if name not in without}
    assert set(documented) == set(parameters)
    for name, parameter in parameters.items():
        says = documented[name]
        assert (says == "required") == parameter.required, name
        if says.startswith("`"):
            assert binding.convert(loader.value_of(says.strip("`")), parameter.annotation) == parameter.default, name
        elif not parameter.required:
            default = binding.plain(parameter.default)
            assert default is None or isinstance(default, dict), f"{name}: its default is {default}"


@pytest.mark.parametrize(
    ("heading", "target", "rest"),
    [
        ("Top level", schema.Scenario, ""),
        ("`[agents]`", schema.AgentsTable, "defaults"),
        ("`[[vehicle]]` and `[vehicles]`", schema.VehicleTable, "params"),
        ("Many at once", loader.Repeat, ""),
        ("`agent = { ... }` of a vehicle", schema.AgentTable, "params"),
        ("`[clock]`", schema.ClockTable, ""),
        ("`[safety]`", schema.SafetyTable, ""),
        ("`[record]`", schema.RecordTable, ""),
        ("`[metrics]`", schema.MetricsTable, ""),
        ("`[study]`", schema.StudyTable, ""),
    ],
)
def test_every_key_of_a_table_is_documented(heading: str, target: Any, rest: str) -> None:
    (documented,) = TABLES[heading]
    assert_documents(documented["default"], target, {rest})


@pytest.mark.parametrize("group", [each for each in builtin_kinds.KINDS if each not in {"physics", "agent"}])
def test_every_kind_is_on_the_page(group: str) -> None:
    """Their parameters: `tests/cosim/reference/test_reference.py`."""
    table = {"door": "bridge.", "stack": "stack."}.get(group, "")
    assert [kind for kind in builtin_kinds.KINDS[group] if f"\n- `{table}{kind}`: " not in TEXT] == []


@pytest.mark.parametrize("target", typing.get_args(schema.InterventionTable))
def test_every_key_of_an_intervention_is_documented(target: Any) -> None:
    (documented,) = TABLES["`[[intervention]]`"]
    assert_documents(documented[target.__struct_config__.tag], target, set())


def test_materials_agree_with_the_walls() -> None:
    match = re.search(r"of kind `itu` has losses for (.*?); these and `stone` have a colour", " ".join(TEXT.split()))
    assert match
    assert re.findall(r"`(\w+)`", match[1]) == list(ITU_MATERIALS)
    assert {*ITU_MATERIALS, "stone"} == {*MATERIAL_COLORS}
