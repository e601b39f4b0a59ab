"""``vcmvsp reference --json-schema``: the schema of scenarios for editors."""

import functools
import json
from typing import Any

import pytest
from jsonschema import Draft7Validator, Draft202012Validator

from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.util.documents import read_toml

pytestmark = pytest.mark.slow

CAR = {"name": "car1", "kind": "p2dx"}


@functools.cache
def validator() -> Draft202012Validator:
    """Validator of the schema that the command prints."""
    schema = json.loads(vcmvsp_command("reference", "--json-schema").out)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def problems(**tables: Any) -> list[str]:
    """Key paths of a scenario that the schema refuses."""
    errors = validator().iter_errors({"name": "test", "duration_s": 1.0, "vehicle": [CAR], **tables})
    return [".".join(map(str, each.absolute_path)) for each in errors]


@pytest.mark.parametrize("name", loader.names())
def test_every_built_in_scenario_is_allowed(name: str) -> None:
    content = read_toml(loader.text_of(name))
    assert [*validator().iter_errors(content)] == []
    assert [*Draft7Validator(validator().schema).iter_errors(content)] == []  # the draft of Taplo


@pytest.mark.parametrize(
    "tables",
    [
        {"radio": {"loss": {"kind": "bernoulli", "probability": 0.3}}},
        {"radio": {"loss": {"kind": "bernoulli"}}},  # a preset gives its probability
        {"radio": {"loss": {"kind": "rain.py:Rain", "mm": 3}}},
        {"agents": {"kind": "mine:Agent", "speed_of_mine": 3}},
        {"vehicles": {"kind": "lag"}, "vehicle": [{"name": "car1", "agent": {}}]},
        {"bridge": {"udp": {}, "second": {"kind": "udp", "port": 1}}},
        {"intervention": [{"kind": "halt", "at_s": 1.0}]},
    ],
)
def test_valid_tables_are_allowed(tables: dict[str, Any]) -> None:
    assert problems(**tables) == []


@pytest.mark.parametrize(
    ("tables", "place"),
    [
        ({"radoi": {}}, ""),
        ({"duration_s": "long"}, "duration_s"),
        ({"radio": {"loss": {"kind": "bernoulli", "probability": 1.5}}}, "radio.loss.probability"),
        ({"radio": {"loss": {"kind": "bernoulli", "probability": 0.5, "probabilty": 0.5}}}, "radio.loss"),
        ({"radio": {"loss": {"kind": "bernouli"}}}, "radio.loss.kind"),
        ({"radio": {"preset": "wifi"}}, "radio.preset"),
        ({"world": {"sed": 3}}, "world"),
        ({"bridge": {"udp": {"prt": 5000}}}, "bridge.udp"),
        ({"agents": {"runs": "somewhere"}}, "agents.runs"),
        ({"vehicle": [{**CAR, "agent": {"kind": "trajectory", "sped": 1.0}}]}, "vehicle.0.agent"),
        ({"vehicle": [{**CAR, "name": "car 1"}]}, "vehicle.0.name"),
        ({"vehicle": [{**CAR, "columns": 2}]}, "vehicle.0"),
        ({"vehicle": [{**CAR, "pose": [0.0, 0.0]}]}, "vehicle.0.pose"),
        ({"vehicle": [{**CAR, "pose": [0.0, 0.0, "north"]}]}, "vehicle.0.pose.2"),
        ({"intervention": [{"kind": "halt", "at_s": 1.0, "for_s": 2.0}]}, "intervention.0"),
    ],
)
def test_invalid_tables_are_refused(tables: dict[str, Any], place: str) -> None:
    assert place in problems(**tables)


def test_a_key_has_its_meaning_unit_and_default() -> None:
    period = validator().schema["properties"]["record"]["properties"]["period_s"]
    assert period == {
        "type": "number", "minimum": 1e-6, "maximum": 1e6,
        "description": "s between recorded states", "unit": "s", "default": 0.1,
    }  # fmt: skip


def test_every_built_in_scenario_names_its_schema_in_its_first_line() -> None:
    texts = [loader.path_of(name).read_text() for name in loader.names()]
    assert all(text.startswith("#:schema ./scenario.schema.json\n# ") for text in texts)
    assert not any(loader.first_words(name).startswith(":") for name in loader.names())


def test_a_section_has_no_schema() -> None:
    assert vcmvsp_command("reference", "radio", "--json-schema").code == 2
