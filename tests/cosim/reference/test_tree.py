"""``vcmvsp reference``: every key of a scenario, from the code."""

import functools
import itertools
import json
import re
from typing import Any

import msgspec
import pytest

from tests.support.cosim.command_line import answer_of, assert_refused, vcmvsp_command
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.reference import describe, tree
from vcmvsp.cosim.reference.describe import Key
from vcmvsp.cosim.reference.tree import Reference, Section
from vcmvsp.cosim.scenario import loader, schema
from vcmvsp.netsim.federate import RadioFederate

KEY = Key(name="size", type="> 0", unit="", schema={}, required=False, default=2.5, without="", meaning="of it, " * 20 + "all")


@functools.cache
def whole() -> Reference:
    """The whole reference, computed by the first test that uses it: each worker collects this file, and one runs it."""
    return tree.full_reference()


def keys(section: str) -> dict[str, list[Key]]:
    """Keys of a section, by the path and kind of their tables."""
    return {f"{each.path} {each.kind}".strip(): list(each.keys) for each in tree.sections_of(section)}


def names(section: str) -> dict[str, list[str]]:
    return {where: [key.name for key in found] for where, found in keys(section).items()}


def test_every_key_of_every_table_is_there() -> None:
    found = {(each.path, each.kind): {key.name for key in each.keys} for each in whole().sections}
    assert found["", ""] == {*binding.parameters(schema.Scenario)}
    assert found["agents", ""] == {*binding.parameters(schema.AgentsTable)} - {"defaults"}
    assert found["vehicle.NAME", ""] == {*binding.parameters(schema.VehicleTable), *loader.KEYS} - {"params"}
    assert found["vehicle.NAME.agent", ""] == {*binding.parameters(schema.AgentTable)} - {"params"}
    assert found["intervention", "outage"] == {*binding.parameters(schema.OutageTable)}
    for name in ("clock", "safety", "record", "metrics", "study"):
        (target,) = binding.structs(binding.parameters(schema.Scenario)[name].annotation)
        assert found[name, ""] == {*binding.parameters(target)}


@pytest.mark.parametrize("place", [place for place in tree.places() if place.kinds], ids=lambda place: place.path)
def test_every_kind_has_all_its_parameters(place: tree.Place) -> None:
    sections = [each for each in whole().sections if each.path == place.path]
    assert [each.kind for each in sections if each.kind] == [*builtin_kinds.KINDS[place.group]]
    shared = {key.name for each in sections if not each.kind for key in each.keys}
    for each in sections:
        if each.kind:
            parameters = {*binding.parameters(registry.find(place.group, each.kind))}
            hidden = {*describe.OFFERED, *itertools.chain(*describe.OFFERED_TO.values())}
            assert parameters - hidden <= {key.name for key in each.keys} | shared


def test_every_key_has_a_meaning_and_required_keys_no_default() -> None:
    entries = [(each.path, each.kind, key) for each in whole().sections for key in each.keys]
    assert [(path, kind, key.name) for path, kind, key in entries if not key.meaning] == []
    assert [
        (path, kind, key.name) for path, kind, key in entries if key.required and (key.default is not None or key.without)
    ] == []


def test_extra_docs_are_of_existing_keys() -> None:
    classes = {**vars(schema), "RadioFederate": RadioFederate}
    for name, docs in describe.EXTRA_DOCS.items():
        assert {*docs} <= {*binding.parameters(classes[name])}, name


def test_defaults_and_units_equal_the_code() -> None:
    (loss,) = keys("radio.loss.bernoulli")["radio.loss bernoulli"]
    assert (loss.required, loss.default, loss.schema) == (True, None, {"type": "number", "minimum": 0, "maximum": 1})
    (period,) = keys("record.period_s")["record"]
    assert (period.unit, period.default, period.meaning) == ("s", 0.1, "s between recorded states")
    (to,) = keys("metrics.to_s")["metrics"]
    assert (to.default, to.without) == (None, "the end")
    (runs,) = keys("agents.runs")["agents"]
    assert runs.schema == {"enum": ["inprocess", "process", "zenoh"]}


@pytest.mark.parametrize(
    ("section", "found"),
    [
        ("radio.loss", ["radio.loss bernoulli", "radio.loss gilbert_elliott", "radio.loss bursts", "radio.loss none"]),
        ("loss", ["radio.loss bernoulli", "radio.loss gilbert_elliott", "radio.loss bursts", "radio.loss none"]),
        ("radio.loss.bursts", ["radio.loss bursts"]),
        ("agents.leader_follower", ["agents", "agents leader_follower"]),
        ("leader_follower", ["agents", "agents leader_follower"]),
        ("vehicle.NAME.sensors.SENSOR.lms", ["vehicle.NAME.sensors.SENSOR", "vehicle.NAME.sensors.SENSOR lms"]),
        ("sensors.lms", ["vehicle.NAME.sensors.SENSOR", "vehicle.NAME.sensors.SENSOR lms"]),
        ("agents.formation.passage", ["agents.formation", "agents.formation.passage"]),
        ("safety", ["safety"]),
        ("intervention.halt", ["intervention halt"]),
        ("world.boxes", ["world", "world boxes", "world.boxes box"]),
    ],
)
def test_a_section_is_a_table_or_a_kind_with_its_contents(section: str, found: list[str]) -> None:
    assert [*names(section)] == found


def test_a_table_is_shown_with_all_within_it() -> None:
    inside = [f"{each.path} {each.kind}".strip() for each in whole().sections if f"{each.path}.".startswith("radio.")]
    assert [*names("radio")] == inside


@pytest.mark.parametrize(
    ("section", "found"),
    [
        ("radio.loss.probability", {"radio.loss bernoulli": ["probability"], "radio.loss bursts": ["probability"]}),
        ("radio.loss.bursts.probability", {"radio.loss bursts": ["probability"]}),
        ("seed", {"": ["seed"]}),
        ("vehicles", {"": ["vehicles"]}),
        ("clamp", {"radio.path_loss log_distance": ["clamp"]}),
        ("handover_s", {"radio": ["handover_s"]}),
    ],
)
def test_a_key_is_shown_alone(section: str, found: dict[str, list[str]]) -> None:
    assert names(section) == found


@pytest.mark.parametrize(
    ("section", "near"),
    [
        ("radoi", "radio"),
        ("radio.los", "loss"),
        ("radio.loss.probabilty", "probability"),
        ("radio.loss.bernouli", "bernoulli"),
        ("leader_folower", "leader_follower"),
        ("agents.leader_folower", "leader_follower"),
    ],
)
def test_an_unknown_section_suggests_the_nearest_name(section: str, near: str) -> None:
    assert_refused(vcmvsp_command("reference", section), f"did you mean '{near}'?")


@pytest.mark.parametrize("section", [".", "NAME", "no such thing"])
def test_an_invalid_name_is_refused(section: str) -> None:
    assert_refused(vcmvsp_command("reference", section))
    assert [*names("radio..")] == [*names("radio")]


def test_without_a_terminal_it_is_plain() -> None:
    head, row = answer_of("reference", "radio.loss.bernoulli").splitlines()
    assert head.startswith('radio.loss, kind = "bernoulli": Every frame is lost with one probability on all links, ')
    assert row == "  probability  0 to 1  required  of a message to be lost, whatever its size"


@pytest.mark.parametrize("width", [40, 80, 200])
def test_terminal_output_fits_and_is_complete(width: int) -> None:
    for section in whole().sections:
        wide, fitted = (" ".join(tree.lines(section, each)).split() for each in (None, width))
        assert wide == fitted
    section = Section(path="a.b", kind="c", listed=False, about="What it is.", keys=(KEY,))
    lines = list(tree.lines(section, width, lambda word: f"<{word}>"))
    assert max(len(re.sub("[<>]", "", line)) for line in lines) <= width
    assert lines[0].startswith('<a.b, kind = "c">:')
    assert any(line.startswith("  <size>  > 0  2.5") for line in lines)


def test_meanings_stand_in_one_column() -> None:
    long = msgspec.structs.replace(KEY, name="breadth", default=None, without="as wide as it is", meaning="from side to side")
    section = Section(path="a", kind="", listed=False, about="", keys=(KEY, long))
    _, first, *_, last = tree.lines(section, 100, lambda word: word)
    assert first.index("of it") == last.index("from side")
    assert next(tree.lines(section)) == "a:"


def test_json_conforms_to_its_types() -> None:
    out = vcmvsp_command("reference", "--json").out
    assert msgspec.json.decode(out, type=Reference, strict=True) == whole()
    assert json.loads(out)["schema"] == "vcmvsp.reference/1"
    (section,) = json.loads(vcmvsp_command("reference", "clock.late", "--json").out)["sections"]
    (key,) = section.pop("keys")
    assert section == {"path": "clock", "kind": "", "listed": False, "about": section["about"]}
    assert {*key} == {*Key.__struct_fields__}


def test_schemas_allow_the_defaults() -> None:
    kinds: dict[str, Any] = {"number": (int, float), "integer": int, "boolean": bool, "string": str, "object": dict}
    for key in (key for each in whole().sections for key in each.keys if key.default is not None):
        if (kind := key.schema.get("type")) in kinds:
            assert isinstance(key.default, kinds[kind]), key
        if choice := key.schema.get("enum"):
            assert key.default in choice, key
