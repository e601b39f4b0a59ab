"""Generate pages from the reference of keys: ``python -m vcmvsp.cosim.reference.markdown --write`` updates them.

The pages in ``docs/reference`` have tables of keys (`cosim.reference.tree`) between two comments. ``reference_keys.tsv``
lists the keys of ``--set`` for fast completion: a line each, with path (NAME, SENSOR and METRIC stand for any name) and
values, separated by tabs.
"""

import argparse
import functools
import inspect
import math
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.assembly.parts.presets import LAYERS, PRESETS, preset
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.metrics.catalogue import METRICS, unit_of
from vcmvsp.cosim.reference import tree
from vcmvsp.cosim.reference.describe import Key, markdown, summary, toml
from vcmvsp.cosim.reference.tree import NOT_SHARED, VEHICLE, Section, full_reference, places

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
INDEX = Path(__file__).resolve().with_name("reference_keys.tsv")
UPDATE = "python -m vcmvsp.cosim.reference.markdown --write"

ABSENT = "–"  # this kind takes no such key
RANGE_BYTES = 100  # size of the frames that define the range of a preset


def updated(page: str, names: Collection[str]) -> str:
    """The page with the present reference between each ``<!-- generated: NAME -->`` and the next ``<!-- end -->``."""
    for name in names:
        before, begin, rest = page.partition(f"<!-- generated: {name} -->\n")
        _, end, after = rest.partition("<!-- end -->\n")
        if not end:
            raise ValueError(f"the page has no block '<!-- generated: {name} -->' ... '<!-- end -->'")
        page = f"{before}{begin}\n{BLOCKS[name]()}\n\n{end}{after}"
    return page


def main(arguments: Sequence[str] | None = None, folder: Path = FOLDER, index: Path = INDEX) -> None:
    """Update the pages in a folder and the index, or report which one is out of date."""
    about = "The reference of keys, from the code."
    parser = argparse.ArgumentParser(prog="python -m vcmvsp.cosim.reference.markdown", description=about)
    parser.add_argument("--write", action="store_true", help="update the files instead of checking them")
    write: bool = parser.parse_args(arguments).write
    written: list[tuple[Path, Callable[[str], str]]] = [(index, lambda _: index_text())]
    written += [(folder / name, functools.partial(updated, names=blocks)) for name, blocks in PAGES.items()]
    for path, fresh in written:
        old = path.read_text("utf-8") if path.exists() else ""
        new = fresh(old)
        if write:
            path.write_text(new, "utf-8")
        elif new != old:
            sys.exit(f"{path} differs from the code; update it: {UPDATE}")


def tables(*paths: str, kinds: Collection[str] = ()) -> str:
    """The sections at these paths and inside: what each is, and its keys; sections with similar keys share a table.

    Args:
        kinds: only the sections of these kinds.
    """
    chosen = [each for path in paths for each in full_reference().sections if f"{each.path}.".startswith(f"{path}.")]
    if kinds:
        chosen = [each for each in chosen if each.path in paths and each.kind in kinds]
    groups: list[list[Section]] = []
    for each in chosen:
        group = next((group for group in groups if _are_alike(group[0], each)), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    return "\n\n".join(map(_table, groups))


def _are_alike(first: Section, second: Section) -> bool:
    """Whether two sections are the same table at two places, or kinds of one table with half of all keys in common."""
    first_keys = {key.name for key in first.keys}
    second_keys = {key.name for key in second.keys}
    if first.path != second.path:
        return (first_keys, first.kind, first.about) == (second_keys, second.kind, second.about)
    return 2 * len(first_keys & second_keys) >= len(first_keys | second_keys)


def _table(sections: Sequence[Section]) -> str:
    """What these sections are, and their keys; a key with several meanings has several rows."""
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for section in sections:
        for key in section.keys:
            is_value = not key.required and key.default is not None
            default = f"`{tree.default_of(key)}`" if is_value else tree.default_of(key)
            rows.setdefault((key.name, key.type, key.meaning), {})[section.kind or "default"] = default
    lines = "\n".join(f"- {_name(each)}: {each.about}" for each in sections)
    if not rows:
        return lines
    columns = dict.fromkeys((each.kind or "default" for each in sections), ABSENT)
    cells = [[f"`{name}`", kind, *(columns | row).values(), means] for (name, kind, means), row in rows.items()]
    return f"{lines}\n\n{grid(['key', 'type, unit', *columns, 'meaning'], cells)}"


def _name(section: Section) -> str:
    """The kind alone, where a scenario has the table once; else the table too."""
    kind, table = f"`{section.kind}`", f"`[[{section.path}]]`" if section.listed else f"`{section.path}`"
    if not section.kind:
        return table
    is_place = any(section.path == place.path for place in places())
    return kind if is_place else f"{table}, kind {kind}"


def radio() -> str:
    """Radio: layers, presets, and a table of parameters for each layer."""
    parts = [_layers(), _presets()]
    for layer in LAYERS:
        parts += [f"### `[radio.{layer}]`", tables(f"radio.{layer}")]
    return "\n\n".join(parts)


def metrics() -> str:
    """Meaning of each number in ``metrics.json``."""
    rows = []
    for name, metric in METRICS.items():
        words = f"{metric.meaning}. {metric.details}" if metric.details else metric.meaning
        rows.append([f"`{name.replace('*', 'NAME')}`", unit_of(name.split(".")) or "1", words.replace("|", "\\|")])
    return grid(["number", "unit", "meaning"], rows)


BLOCKS: Mapping[str, Callable[[], str]] = {
    "physics": lambda: tables("physics"),
    "world": lambda: tables("world"),
    "radio": radio,
    "sensors": lambda: tables(f"{VEHICLE}.sensors"),
    "vehicle radio": lambda: tables(f"{VEHICLE}.radio"),
    "vehicle battery": lambda: tables(f"{VEHICLE}.battery"),
    "vehicle clock": lambda: tables(f"{VEHICLE}.clock"),
    "own metrics": lambda: tables("metrics.own.METRIC"),
    "vehicle kinds": lambda: tables(VEHICLE, kinds=builtin_kinds.KINDS["vehicle"]),
    "leaders": lambda: tables("agents", kinds=["trajectory", "route", "teleop"]),
    "followers": lambda: tables("agents", kinds=["leader_follower"]),
    "consensus": lambda: tables("agents", kinds=["consensus"]),
    "team": lambda: tables("agents.formation", "agents.sending", "agents.avoidance"),
    "patrol": lambda: tables("agents", kinds=["patrol"]),
    "time sync": lambda: tables("agents", kinds=["time_sync"]),
    "aerial": lambda: tables("agents", kinds=["aerial_route", "aerial_follower"]),
    "avoid": lambda: tables("agents", kinds=["avoid"]),
    "mission": lambda: tables("agents", kinds=["mission"]),
    "search": lambda: tables("agents", kinds=["search"]),
    "track": lambda: tables("agents", kinds=["track"]),
    "watching": lambda: tables("agents.watching", "agents.mosaic"),
    "drivers": lambda: tables(f"{VEHICLE}.driver"),
    "firmware": lambda: tables(f"{VEHICLE}.firmware"),
    "localisation": lambda: tables(f"{VEHICLE}.localisation"),
    "fusion": lambda: tables(f"{VEHICLE}.fusion"),
    "safety": lambda: tables("safety"),
    "clock": lambda: tables("clock"),
    "routing": lambda: tables("routing"),
    "doors": lambda: tables(*tree.DOORS),
    "sockets": lambda: tables("sockets"),
    "stacks": lambda: tables(*tree.STACKS),
    "metrics": metrics,
}
PAGES: Mapping[str, Collection[str]] = {
    "scenario.md": ("routing", "doors", "sockets"),
    "scenario-world.md": ("physics", "world"),
    "scenario-radio.md": ("radio",),
    "scenario-vehicles.md": ("sensors", "vehicle radio", "vehicle battery", "vehicle clock", "vehicle kinds"),
    "scenario-agents.md": (
        *("leaders", "followers", "consensus", "team", "patrol", "time sync", "aerial", "avoid", "mission", "search"),
        *("track", "watching"),
    ),
    "scenario-robots.md": ("drivers", "localisation", "fusion", "safety", "clock", "firmware", "stacks"),
    "metrics.md": ("own metrics", "metrics"),
}
"""Blocks of each page."""


def _layers() -> str:
    """Description of each layer: the first words of the module of its first kind."""
    rows = []
    for layer in LAYERS:
        kinds_of = builtin_kinds.KINDS[layer]
        about = inspect.getmodule(registry.find(layer, next(iter(kinds_of))))
        rows.append([f"`{layer}`", markdown(summary(about)), ", ".join(f"`{kind}`" for kind in kinds_of)])
    return grid(["layer", "meaning", "kinds"], rows)


def _presets() -> str:
    """Keys that each preset sets beyond the defaults of its kinds, and its range."""
    tables = {name: preset(name) for name in PRESETS}
    first, *others = tables.values()

    def differs(layer: str) -> bool:
        return any(each[layer] != first[layer] for each in others)

    differ = list(filter(differs, LAYERS))
    rows = []
    for name, content in tables.items():
        rows.append([f"`{name}`", *(_setting(layer, content[layer]) for layer in differ), _length(reach_m(content))])
    alike = [layer for layer in LAYERS if layer not in differ]
    same = "; ".join(f"{layer.replace('_', ' ')} is {_setting(layer, first[layer])}" for layer in alike)
    return (
        f"{grid(['preset', *(layer.replace('_', ' ') for layer in differ), 'range'], rows)}\n\n"
        f"Other keys have the default of their kind. In all presets {same}. The range is the distance over which half of all "
        f"frames with {RANGE_BYTES} bytes are received where nothing but distance weakens them and nobody else sends."
    )


def _setting(layer: str, content: Mapping[str, Any]) -> str:
    parameters = binding.parameters(registry.find(layer, content["kind"]))
    words = [f"`{content['kind']}`"]
    for name, value in params(content).items():
        if parameters[name].required or parameters[name].default != value:
            words.append(f"`{name} = {toml(value)}`")
    return ", ".join(words)


def _length(metres: float) -> str:
    if not math.isfinite(metres):
        return ABSENT if math.isnan(metres) else "unlimited"
    return f"{metres:.1f} m" if metres < 1000.0 else f"{metres / 1000.0:.1f} km"


def reach_m(tables: Mapping[str, Mapping[str, Any]]) -> float:
    """Range of a preset, m: half of all frames of `RANGE_BYTES` are received there, ``d0 10^((P - L0 - S) / (10 N))``.

    S is the sensitivity, or the level that the SNR of the preamble or of the payload needs, if that is higher.
    """
    law, mac = _complete("path_loss", tables), _complete("mac", tables)
    if law["kind"] != "log_distance":
        return math.inf if law["kind"] == "none" else math.nan
    phy = binding.call(registry.find("phy", tables["phy"]["kind"]), params(tables["phy"]))
    noise_dbm, errors = getattr(phy, "noise_dbm", -math.inf), getattr(phy, "errors", None)
    snr_db = mac.get("preamble_snr_db", getattr(phy, "preamble_snr_db", -math.inf))
    if errors is not None:
        ratios_db = np.arange(-20.0, 40.0, 1e-3)
        snr_db = max(snr_db, ratios_db[np.argmax(errors.frame_success(ratios_db, RANGE_BYTES) >= 0.5)])
    sensitivity_dbm = -math.inf if mac["kind"] == "csma154" else phy.sensitivity_dbm  # not a reception threshold there
    margin_db = phy.tx_power_dbm - law["reference_loss_db"] - max(sensitivity_dbm, noise_dbm + snr_db)
    return float(law["reference_distance_m"] * 10.0 ** (margin_db / (10.0 * law["exponent"])))


def _complete(layer: str, tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    content = tables[layer]
    return {**content, **binding.complete(registry.find(layer, content["kind"]), params(content))}


def params(content: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a table except its kind."""
    return {name: value for name, value in content.items() if name != "kind"}


def grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, *rows]).replace("\n", f"\n|{'---|' * len(heads)}\n", 1)


@functools.cache
def index_text() -> str:
    """The up-to-date content of the index."""
    values_of: dict[str, dict[str, None]] = {}
    for path, values in _entries():
        values_of.setdefault(path, {}).update(dict.fromkeys(values))
    tables = {"vehicle", *(path.rpartition(".")[0] for path in values_of)}
    tables |= {each.path for each in full_reference().sections if each.listed}
    return "".join("\t".join([path, *values]) + "\n" for path, values in values_of.items() if path not in tables)


def _entries() -> Iterator[tuple[str, list[str]]]:
    kinds = [(place.path, list(place.kinds)) for place in places() if place.kinds]
    kinds += [(each.path, [each.kind]) for each in full_reference().sections if each.kind and _is_set(each)]
    for path, names in kinds:
        yield from ((f"{where}.kind", names) for where in _paths(path, "kind"))
    for section in full_reference().sections:
        if _is_set(section):
            for key in section.keys:
                yield from ((binding.join(where, key.name), _values(key)) for where in _paths(section.path, key.name))


def _paths(path: str, key: str) -> list[str]:
    """Paths of the tables that may have a key of this table: agents and vehicles also have shared defaults."""
    first, _, rest = path.partition(".")
    if first == "agents":
        return [path, binding.join(f"{VEHICLE}.agent", rest)]
    if path == VEHICLE:
        return [path] if key in NOT_SHARED else [path, "vehicles"]
    return [path]


def _is_set(section: Section) -> bool:
    """Whether ``--set`` reaches a section: it is neither in a list of tables nor nested in one, as an obstacle's solid is."""
    return not any(each.listed and f"{section.path}.".startswith(f"{each.path}.") for each in full_reference().sections)


def _values(key: Key) -> list[str]:
    """Completion values of a key: its choices, or its default."""
    values: list[Any] = key.schema.get("enum", [True, False] if key.schema.get("type") == "boolean" else [])
    if not values and isinstance(key.default, str | float | int):
        values = [key.default]
    words = [_bare(each) for each in values]
    return [word for word in words if word and not set(word) & set(" \t\n'\"")]


def _bare(value: object) -> str:
    return value if isinstance(value, str) else toml(value)


if __name__ == "__main__":
    main()
