"""The reference of scenario keys says what the software does. (`test_gallery.py` tests the gallery.)"""

import re
import typing
from typing import Any

import pytest

from tests.support.paths import SCENARIOS
from vcmvsp.agents.avoidance import DynamicWindow, Gap, PotentialField, Vfh
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.agents.reconnaissance.picture_recording import Mosaicking
from vcmvsp.agents.reconnaissance.watch import Wanted, Watching
from vcmvsp.cosim.assembly.parts.presets import LAYERS, PRESETS
from vcmvsp.cosim.assembly.parts.radio import Radio
from vcmvsp.cosim.assembly.parts.vehicles import Positioning
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.reference import describe, markdown
from vcmvsp.cosim.scenario import loader, schema
from vcmvsp.netsim.impairments.jammer import Emitter
from vcmvsp.netsim.impairments.script import Change
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS
from vcmvsp.physics.sensors.sensor import Noise
from vcmvsp.physics.world.floor import GroundPicture, GroundTarget, Mark
from vcmvsp.physics.world.solids import MATERIAL_COLORS, Box, Cylinder, Prism
from vcmvsp.physics.world.world import Light, Movable, Moving, Wind, Zone

FOLDER = SCENARIOS
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
    "vehicle": tuple(markdown.VEHICLES),
    "sensor": ("`sensors = { NAME = { kind = ... }, ... }`",),
    "driver": ("`driver = { kind = ... }` of a vehicle",),
    "localisation": ("`localisation = { kind = ... }` of a vehicle",),
    "agent": ("Leaders", "Followers", "In the air", "Consensus", "Patrols", "Avoidance around any agent", "Missions"),
    "door": ("`[bridge]`",),
    "routing": ("`[routing]`",),
    **{layer: (f"`[radio.{layer}]`",) for layer in LAYERS},
}
FROM_ELSEWHERE = {*describe.OFFERED}  # parameters that come from the rest of the scenario
OF_PHYSICS, OF_ROBOTS = ({*describe.OFFERED_TO[part]} for part in ("physics", "hardware"))


def by_kind(*headings: str) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for heading in headings:
        for name, keys in ((name, keys) for one in TABLES[heading] for name, keys in one.items()):
            assert not {*found.get(name, {})} & {*keys}, "a key stands in two tables"
            found.setdefault(name, {}).update(keys)
    return found


def of_kind(group: str, kind: str, wanted: set[str]) -> dict[str, str]:
    """What the tables say of a kind: its own, and what it has in common with others."""
    tables = by_kind(*HEADINGS[group])
    common = tables.get("quadrotor" if kind == "urdf-quadrotor" else "default", {})
    return {**{name: says for name, says in common.items() if name in wanted}, **tables.get(kind, {})}


def assert_documents(documented: dict[str, str], target: Any, without: set[str]) -> None:
    """Every key once, ``required`` where it is, and the default as TOML where TOML can say it."""
    wanted = {name: each for name, each in binding.parameters(target).items() if name not in without}
    assert set(documented) == set(wanted)
    for name, parameter in wanted.items():
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


@pytest.mark.parametrize("target", typing.get_args(schema.InterventionTable))
def test_every_key_of_an_intervention_is_documented(target: Any) -> None:
    (documented,) = TABLES["`[[intervention]]`"]
    assert_documents(documented[target.__struct_config__.tag], target, set())


@pytest.mark.parametrize(("group", "kind"), [(group, kind) for group, kinds in builtin_kinds.KINDS.items() for kind in kinds])
def test_every_kind_is_documented_with_all_its_parameters(group: str, kind: str) -> None:
    target = registry.find(group, kind)
    if group not in {"physics", "agent"}:
        sections = [TEXT.partition(f"# {heading}\n")[2].partition("\n#")[0] for heading in HEADINGS[group]]
        assert sum(f"\n- `{kind}`: " in section for section in sections) == 1
    theirs = {"physics": OF_PHYSICS, "driver": OF_ROBOTS, "localisation": OF_ROBOTS}
    hidden = FROM_ELSEWHERE | theirs.get(group, set())
    if wanted := set(binding.parameters(target)) - hidden:
        assert_documents(of_kind(group, kind, wanted), target, hidden)


@pytest.mark.parametrize(
    ("heading", "item", "target"),
    [
        *[("`[world]`", each.__name__.lower(), each) for each in (Box, Cylinder, Prism, Movable, Moving, Zone, Wind, Light)],
        *[("`[world]`", each.__name__.lower(), each) for each in (GroundPicture, Mark, GroundTarget)],
        (*HEADINGS["sensor"], "noise", Noise),
        ("`positioning = { ... }`", "positioning", Positioning),
        ("`radio = { ... }`", "default", Radio),
        ("Formations, and when their members report", "formation", Formation),
        ("Formations, and when their members report", "sending", Sending),
        ("Formations, and when their members report", "passage", Passage),
        ("Formations, and when their members report", "potential_field", PotentialField),
        *(("Missions", each.__name__.lower(), each) for each in (Watching, Wanted, Mosaicking)),
        ("Formations, and when their members report", "gap", Gap),
        ("Formations, and when their members report", "vfh", Vfh),
        ("Formations, and when their members report", "dynamic_window", DynamicWindow),
        ("`[radio.script]`", "change", Change),
        ("`[radio.jammer]`", "emitter", Emitter),
    ],
)
def test_what_lists_and_vehicles_hold_is_documented(heading: str, item: str, target: Any) -> None:
    assert_documents(by_kind(heading)[item], target, set())


def test_every_preset_is_documented() -> None:
    rows = [line.split("`")[1] for line in TEXT.splitlines() if re.match(r"\| `[a-z0-9.-]+` \| `(none|log_distance)`", line)]
    assert rows == list(PRESETS)


def test_materials_are_those_that_walls_are_made_of() -> None:
    said = re.search(r"of kind `itu` knows (.*?), and those six and `stone` have a colour", " ".join(TEXT.split()))
    assert said
    assert re.findall(r"`(\w+)`", said[1]) == list(ITU_MATERIALS)
    assert {*ITU_MATERIALS, "stone"} == {*MATERIAL_COLORS}
