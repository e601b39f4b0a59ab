"""The reference pages agree with the code. (`tests/docs/test_reference.py` reads the page itself.)"""

import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel, send
from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.reference import describe, tree
from vcmvsp.cosim.reference import markdown as reference
from vcmvsp.cosim.reference.markdown import reach_m
from vcmvsp.cosim.reference.tree import Reference, Section
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.types import Message, NonNegative, Positive, Probability, Seconds, Seed, Vec3
from vcmvsp.netsim.presets import LAYERS, PRESETS, preset

pytestmark = pytest.mark.processes

ALL_BLOCKS = "''.join(write() for write in reference.BLOCKS.values())"
REQUIRED = {"probability": 0.1, "quantiles": [[0.0, 0.0], [1.0, 0.1]], "file": "links.csv"}  # all others may be 0.1


class Drop(msgspec.Struct):
    """It is wet."""

    size_m: float  # across


@dataclass
class Rain:
    """It rains: ``water`` falls."""

    db_per_km: NonNegative = 2.0  # what it takes
    tau_s: Seconds | None = None  # how long; None: for ever
    drops: tuple[Drop, ...] = ()  # what falls


@dataclass
class Snow:
    """It snows."""

    db_per_km: NonNegative  # what it takes
    tau_s: Positive = 60.0  # how long


class Shower(msgspec.Struct, frozen=True):
    mm: float = 1.0  # in an hour
    drops: tuple[Drop, ...] = ()  # of which it is


SHOWER, HEAVY = Shower(), Shower(mm=2.0)


@dataclass
class Storm:
    """Wind."""

    wind: float = 3.0  # m/s


@dataclass
class Hail(Storm):
    """Ice (kind ``hail``)."""

    wind: float = 5.0  # assumed
    grain_m: float = 0.01  # across


@dataclass
class Sleet(Hail):
    """Ice and water."""

    wind: float = 3.0
    grain_m: float = 0.001  # measured by nobody


@pytest.fixture(scope="module", autouse=True)
def blocks() -> Iterator[dict[str, str]]:
    """All generated blocks, once: generation is slow."""
    written = {name: write() for name, write in reference.BLOCKS.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference, "BLOCKS", {name: partial(written.get, name) for name in written})
        yield written


def test_pages_and_index_are_up_to_date() -> None:
    assert sorted(name for names in reference.PAGES.values() for name in names) == sorted(reference.BLOCKS)
    for page, names in reference.PAGES.items():
        text = (reference.FOLDER / page).read_text("utf-8")
        assert reference.updated(text, names) == text, reference.UPDATE
    assert reference.INDEX.read_text("utf-8") == reference.index_text(), reference.UPDATE


@pytest.mark.parametrize(
    "change", [("`40.052`", "`40.05`"), ("| 85.6 m |", "| 86 m |"), ("<!-- end -->", "more\n<!-- end -->")]
)
def test_an_outdated_page_is_reported_and_repaired(tmp_path: Path, change: tuple[str, str]) -> None:
    folder, index = tmp_path / "reference", tmp_path / "keys.tsv"
    shutil.copytree(reference.FOLDER, folder)
    page = folder / "scenario-radio.md"
    fresh = page.read_text("utf-8")
    page.write_text(fresh.replace(*change, 1), "utf-8")
    assert page.read_text("utf-8") != fresh
    with pytest.raises(
        SystemExit, match=re.escape("differs from the code; update it: python -m vcmvsp.cosim.reference.markdown --write")
    ):
        reference.main([], folder, index)
    reference.main(["--write"], folder, index)
    assert (page.read_text("utf-8"), index.read_text("utf-8")) == (fresh, reference.index_text())
    reference.main([], folder, index)
    index.write_text("seed\n")
    with pytest.raises(SystemExit, match="differs from the code"):
        reference.main([], folder, index)


def test_text_around_the_blocks_stays() -> None:
    head, tail = "before\n<!-- end -->\n", "\nafter <!-- generated: radio -->\n"
    blocks = "".join(f"<!-- generated: {name} -->\nold\n<!-- end -->\n" for name in reference.BLOCKS)
    page = reference.updated(head + blocks + tail, reference.BLOCKS)
    assert page.startswith(head)
    assert page.endswith(tail)
    assert "\nold\n" not in page


def test_a_page_without_the_block_is_refused() -> None:
    with pytest.raises(ValueError, match="no block '<!-- generated: physics -->'"):
        reference.updated("# Nothing\n", ["physics"])


def test_it_is_equal_in_every_process(blocks: dict[str, str]) -> None:
    code = (
        f"from vcmvsp.cosim.reference import markdown as reference; import sys; sys.stdout.buffer.write({ALL_BLOCKS}.encode())"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"}  # another seed
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=environment).stdout
    assert output.decode() == "".join(blocks.values())


@pytest.mark.parametrize(("layer", "kind"), [(layer, kind) for layer in LAYERS for kind in builtin_kinds.KINDS[layer]])
def test_the_keys_of_a_kind_are_the_settable_ones(layer: str, kind: str, tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text("time_s,sender,receiver,loss\n0,a,b,1\n")
    known = describe.keys(registry.find(layer, kind))
    values = {name: REQUIRED.get(name, 0.1) for name, each in known.items() if each.required}
    source = Source("test", tmp_path)
    preset = {"dcf": "wifi-b-1", "csma154": "zigbee"}.get(kind, "ideal")  # a mac needs a phy of its standard
    others = {"path_loss": {"kind": "rays"}} if kind == "geometric" else {}
    _, resolved = radio.build({"preset": preset, **others, layer: {"kind": kind, **values}}, source, vehicles=("a", "b"))
    assert set(resolved[layer]) == {"kind", *values, *(name for name, each in known.items() if each.default is not None)}
    for name in describe.OFFERED:
        if name in binding.parameters(registry.find(layer, kind)):  # from other parts of the scenario, not a key
            with pytest.raises(ScenarioError, match=f"unknown key '{name}'"):
                radio.build({**others, layer: {"kind": kind, **values, name: 0.1}}, source, vehicles=("a", "b"))


@pytest.mark.parametrize("name", PRESETS)
def test_the_table_of_presets_and_the_defaults_give_each_preset(name: str, blocks: dict[str, str]) -> None:
    heads, _, *rows = [line.strip("| ").split(" | ") for line in blocks["radio"].split("\n\n")[1].splitlines()]
    (row,) = [dict(zip(heads, row, strict=True)) for row in rows if row[0] == f"`{name}`"]
    same = re.search(r"In all presets (.*?)\. The range", blocks["radio"])
    assert same
    texts = {head.replace(" ", "_"): text for head, text in row.items() if head not in {"preset", "range"}}
    texts |= {each.partition(" is ")[0].replace(" ", "_"): each.partition(" is ")[2] for each in same[1].split("; ")}
    for layer, content in preset(name).items():
        kind, *settings = re.findall(r"`([^`]+)`", texts[layer])
        values = {key: loader.value_of(value) for key, _, value in (each.partition(" = ") for each in settings)}
        assert kind == content["kind"]
        target = registry.find(layer, kind)
        own = {key: value for key, value in content.items() if key != "kind"}
        assert binding.complete(target, values, describe.OFFERED) == binding.complete(target, own, describe.OFFERED)


@pytest.mark.parametrize("name", PRESETS)
def test_at_the_range_of_a_preset_half_of_the_frames_are_received(name: str) -> None:
    range_m = reach_m(preset(name))
    if math.isinf(range_m):
        assert send(make_channel(name), 1e9).outcome == ("received",)
        return
    channel = make_channel(name, mac=preset(name)["mac"])
    receivers = np.repeat([range_m * 0.95, range_m * 1.05], 50)
    names = ("car0", *(f"car{k}" for k in range(1, 101)))
    position = np.stack([np.concatenate([[0.0], receivers]), np.zeros(101), np.zeros(101)], axis=-1)
    message = Message(sender="car0", body={}, size_bytes=100)
    (report,) = channel.send(0, message, names, position) or channel.advance(10**10)
    near, far = np.split(report.received_ns >= 0, 2)
    assert near.mean() > 0.5 > far.mean()


def test_ranges_equal_published_ones() -> None:
    # d0 10^((Pd0 - cutoff) / (10 N)) of the Wireless Simulation Server; ns-3.44 at -82 dBm and exponent 3.
    ranges = [reach_m(preset(name)) for name in ("wss", "wifi-b-1")]
    assert ranges == pytest.approx([2.0 * 10.0 ** ((-49.67 + 93.0) / 10.0), 85.565], abs=5e-3)
    layers = preset("wss")
    for exponent, range_m in ((2.0, 293.4), (2.5, 108.2), (3.0, 55.6), (4.0, 24.2)):
        layers["path_loss"]["exponent"] = exponent
        assert reach_m(layers) == pytest.approx(range_m, abs=0.05)


def section(kind: type, path: str = "weather", common: type | None = None) -> Section:
    keys = tuple(key for key, _ in describe.keys_of(kind, common))
    return Section(path=path, kind=kind.__name__.lower(), listed=False, about=describe.about(kind), keys=keys)


@pytest.fixture
def weather(monkeypatch: pytest.MonkeyPatch) -> None:
    sections = [section(Rain), section(Drop, "weather.drops"), section(Snow), section(Drop, "weather.others")]
    monkeypatch.setattr(reference, "full_reference", lambda: Reference(sections=tuple(sections)))


@pytest.mark.usefixtures("weather")
def test_similar_kinds_share_a_table_and_repeated_tables_appear_once() -> None:
    assert reference.tables("weather").splitlines() == [
        "- `weather`, kind `rain`: It rains: `water` falls.",
        "- `weather`, kind `snow`: It snows.",
        "",
        "| key | type, unit | rain | snow | meaning |",
        "|---|---|---|---|---|",
        "| `db_per_km` | >= 0 | `2.0` | required | what it takes |",
        "| `tau_s` | s, 0 to 1e9 | for ever | – | how long |",
        "| `drops` | list of tables | `[]` | – | what falls |",
        "| `tau_s` | s, > 0 | – | `60.0` | how long |",
        "",
        "- `weather.drops`, kind `drop`: It is wet.",
        "- `weather.others`, kind `drop`: It is wet.",
        "",
        "| key | type, unit | drop | meaning |",
        "|---|---|---|---|",
        "| `size_m` | m | required | across |",
    ]


@pytest.mark.usefixtures("weather")
def test_selected_kinds_are_shown_without_inner_tables() -> None:
    assert [line for line in reference.tables("weather", kinds=["snow"]).splitlines() if line.startswith("- ")] == [
        "- `weather`, kind `snow`: It snows."
    ]


def test_a_default_table_shows_only_changed_values() -> None:
    @dataclass
    class Weather:
        rain: Shower = SHOWER  # it falls
        more: Shower = HEAVY  # later

    assert [tree.default_of(key) for key, _ in describe.keys_of(Weather)] == ["{}", "{ mm = 2.0 }"]


def test_a_key_keeps_the_meaning_of_its_first_class() -> None:
    hail, sleet = (section(kind, common=Storm) for kind in (Hail, Sleet))
    assert [(key.name, key.default, key.meaning) for key in hail.keys] == [("wind", 5.0, "m/s"), ("grain_m", 0.01, "across")]
    assert [(key.name, key.default, key.meaning) for key in sleet.keys] == [("grain_m", 0.001, "across")]


@pytest.mark.parametrize(
    ("name", "annotation", "words"),
    [
        ("share", Probability, "0 to 1"),
        ("share", float, "number"),
        ("to_bad_per_s", Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)], "1/s, 1e-6 to 1e6"),
        ("waves", Annotated[int, msgspec.Meta(ge=1, le=4096)], "whole number 1 to 4096"),
        ("delay_s", Seconds | None, "s, 0 to 1e9"),
        ("gain_dbi", float, "dBi"),
        ("place", Vec3, "list of 3 values, each a number"),
        ("band", Literal["a", "b"], "one of 'a', 'b'"),
        ("drops", tuple[Drop, ...], "list of tables: see below"),
        ("drop", Drop | None, "table: see below"),
        ("seed", Seed, "whole number >= 0"),
        ("losses_db", dict[str, NonNegative], "dB, table"),
    ],
)
def test_types_and_units(name: str, annotation: Any, words: str) -> None:
    assert describe.type_of(name, annotation) == words


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (40.052, "40.052"),
        (-300.0, "-300.0"),
        (2.4e9, "2.4e9"),
        (11e6, "11e6"),
        (1e-6, "1e-6"),
        (0.0, "0.0"),
        (1023, "1023"),
        (True, "true"),
        ("5GHz", '"5GHz"'),
        (["**"], '["**"]'),
        ({}, "{}"),
        ({"brick": 3.5, "wood": 1e6}, "{ brick = 3.5, wood = 1e6 }"),
    ],
)
def test_values_are_written_as_toml_reads_them(value: Any, text: str) -> None:
    assert describe.toml(value) == text
    assert loader.value_of(text) == value


@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**63), 2**63 - 1))
def test_every_number_is_read_as_it_was(value: float) -> None:
    assert loader.value_of(describe.toml(value)) == value
