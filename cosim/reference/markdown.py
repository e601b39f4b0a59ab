"""Generate pages from the reference of keys: ``python -m vcmvsp.cosim.reference.markdown --write`` updates them.

``scenarios/README.md`` has tables of keys (`cosim.reference.describe`) between two comments. ``reference_keys.tsv`` lists the
keys of ``--set`` for fast completion: a line each, with path (NAME and SENSOR stand for any name) and values, separated by
tabs.
"""

import argparse
import functools
import inspect
import math
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.assembly.parts.presets import LAYERS, PRESETS, preset
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.metrics.catalogue import METRICS, unit_of
from vcmvsp.cosim.reference import tree
from vcmvsp.cosim.reference.describe import (
    Described,
    Key,
    about,
    common_of,
    default_of,
    first_meanings,
    keys,
    markdown,
    said,
    summary,
    toml,
    type_of,
)
from vcmvsp.cosim.reference.tree import NOT_SHARED, VEHICLE, Section, places, whole
from vcmvsp.cosim.scenario.loader import BUILT_IN
from vcmvsp.cosim.scenario.schema import ClockTable, SafetyTable, SocketsTable

PAGE = BUILT_IN / "README.md"
INDEX = Path(__file__).resolve().with_name("reference_keys.tsv")
UPDATE = "python -m vcmvsp.cosim.reference.markdown --write"

VEHICLES: Mapping[str, Sequence[Sequence[str]]] = {
    "Vehicles that are points": [["kinematic", "lag", "inertial"]],
    "Robots with two driven wheels and a caster": [["p2dx", "amigobot"]],
    "Vehicles that fly": [["quadrotor"], ["point"]],
    "Vehicles of your own, from URDF": [["urdf"], ["urdf-quadrotor"]],
}
"""Kinds of vehicles that share a table, by heading."""

ABSENT = "–"  # this kind takes no such key
RANGE_BYTES = 100  # size of the frames that define the range of a preset


def updated(page: str) -> str:
    """The page with the present reference between each ``<!-- generated: NAME -->`` and the next ``<!-- end -->``."""
    for name, write in BLOCKS.items():
        before, begin, rest = page.partition(f"<!-- generated: {name} -->\n")
        _, end, after = rest.partition("<!-- end -->\n")
        if not end:
            raise ValueError(f"the page has no block '<!-- generated: {name} -->' ... '<!-- end -->'")
        page = f"{before}{begin}\n{write()}\n\n{end}{after}"
    return page


def main(arguments: Sequence[str] | None = None, page: Path = PAGE, index: Path = INDEX) -> None:
    """Update page and index, or report which one is out of date."""
    about = "The reference of keys, from the code."
    parser = argparse.ArgumentParser(prog="python -m vcmvsp.cosim.reference.markdown", description=about)
    parser.add_argument("--write", action="store_true", help="update the files instead of checking them")
    write: bool = parser.parse_args(arguments).write
    for path, fresh in ((page, updated), (index, lambda _: index_text())):
        old = path.read_text("utf-8") if path.exists() else ""
        new = fresh(old)
        if write:
            path.write_text(new, "utf-8")
        elif new != old:
            sys.exit(f"{path} is not what the code says; update it: {UPDATE}")


def physics() -> str:
    """Parameters of both kinds of physics."""
    return parameter_table({"bullet, kinematic": registry.find("physics", "bullet")})


def vehicles() -> str:
    """Parameters of vehicles: tables under headings."""
    parts = []
    for heading, tables in VEHICLES.items():
        parts.append(f"#### {heading}")
        for names in tables:
            classes = {kind: registry.find("vehicle", kind) for kind in names}
            parts.append(kinds(classes, registry.find("vehicle", "quadrotor") if names == ["urdf-quadrotor"] else None))
    return "\n\n".join(parts)


def families(group: str) -> str:
    """Common parameters of a group's kinds, then each kind and its bases, then the tables they hold."""
    classes = {kind: registry.find(group, kind) for kind in builtin_kinds.KINDS[group]}
    common = common_of(classes.values())
    alike: dict[type, dict[str, type]] = {}
    for kind, each in classes.items():
        line = each.__mro__
        alike.setdefault(line[line.index(common) - 1] if common in line else each, {})[kind] = each
    parts = [parameter_table({"default": common}), *(kinds(each, common) for each in alike.values())]
    return "\n\n".join([*parts, *lists([common, *classes.values()])])


def radio() -> str:
    """Radio: layers, presets, and a table of parameters for each layer."""
    parts = [_layers(), _presets()]
    for layer in LAYERS:
        classes = {kind: registry.find(layer, kind) for kind in builtin_kinds.KINDS[layer]}
        parts += [f"#### `[radio.{layer}]`", kinds(classes), *lists(classes.values())]
    return "\n\n".join(parts)


def agents(*names: str) -> str:
    """The parameters of kinds of agents."""
    return kinds({name: registry.find("agent", name) for name in names})


def apart(group: str) -> str:
    """Kinds of a group with little in common: a table each, and the tables they hold."""
    classes = {kind: registry.find(group, kind) for kind in builtin_kinds.KINDS[group]}
    return "\n\n".join([*(kinds({kind: each}) for kind, each in classes.items()), *lists(classes.values())])


def only(classes: Sequence[type]) -> str:
    """Parameters of the only class of a table, and the tables it holds."""
    (target,) = classes
    return "\n\n".join([parameter_table({"default": target}), *lists([target])])


def team() -> str:
    """Tables that agents of a team hold."""
    return "\n\n".join(lists([registry.find("agent", "leader_follower")]))


def metrics() -> str:
    """Meaning of each number in ``metrics.json``."""
    rows = []
    for name, metric in METRICS.items():
        words = f"{metric.meaning}. {metric.details}" if metric.details else metric.meaning
        rows.append([f"`{name.replace('*', 'NAME')}`", unit_of(name.split(".")) or "1", words.replace("|", "\\|")])
    return grid(["number", "unit", "meaning"], rows)


BLOCKS: Mapping[str, Callable[[], str]] = {
    "physics": physics,
    "world": lambda: families("world"),
    "radio": radio,
    "sensors": lambda: families("sensor"),
    "vehicle radio": lambda: only(tree.vehicle_radio()),
    "vehicle kinds": vehicles,
    "leaders": lambda: agents("trajectory", "route", "teleop"),
    "followers": lambda: agents("leader_follower"),
    "consensus": lambda: agents("consensus"),
    "team": team,
    "patrol": lambda: agents("patrol"),
    "aerial": lambda: agents("aerial_route", "aerial_follower"),
    "avoid": lambda: agents("avoid"),
    "mission": lambda: agents("mission"),
    "search": lambda: agents("search"),
    "track": lambda: agents("track"),
    "watching": lambda: "\n\n".join(lists([registry.find("agent", "track")])),
    "drivers": lambda: apart("driver"),
    "localisation": lambda: apart("localisation"),
    "fusion": lambda: only(tree.fusion()),
    "safety": lambda: parameter_table({"default": SafetyTable}),
    "clock": lambda: parameter_table({"default": ClockTable}),
    "routing": lambda: apart("routing"),
    "doors": lambda: apart("door"),
    "sockets": lambda: parameter_table({"default": SocketsTable}),
    "metrics": metrics,
}


def _layers() -> str:
    """Description of each layer: the first words of the module of its first kind."""
    rows = []
    for layer in LAYERS:
        kinds_of = builtin_kinds.KINDS[layer]
        about = inspect.getmodule(registry.find(layer, next(iter(kinds_of))))
        rows.append([f"`{layer}`", markdown(summary(about)), ", ".join(f"`{kind}`" for kind in kinds_of)])
    return grid(["layer", "what it is about", "kinds"], rows)


def _presets() -> str:
    """Keys that each preset sets beyond the defaults of its kinds, and its range."""
    tables = {name: preset(name) for name in PRESETS}
    first = tables[PRESETS[0]]
    alike = [layer for layer in LAYERS if all(each[layer] == first[layer] for each in tables.values())]
    differ = [layer for layer in LAYERS if layer not in alike]
    rows = []
    for name, content in tables.items():
        rows.append([f"`{name}`", *(_setting(layer, content[layer]) for layer in differ), _length(reach_m(content))])
    same = "; ".join(f"{layer.replace('_', ' ')} is {_setting(layer, first[layer])}" for layer in alike)
    return (
        f"{grid(['preset', *(layer.replace('_', ' ') for layer in differ), 'range'], rows)}\n\n"
        f"What is not said is the kind's default. In all presets {same}. The range is the distance over which half of all "
        f"frames with {RANGE_BYTES} bytes are received where nothing but distance weakens them and nobody else sends."
    )


def _setting(layer: str, content: Mapping[str, Any]) -> str:
    known = binding.parameters(registry.find(layer, content["kind"]))
    own = {name: value for name, value in params(content).items() if known[name].required or known[name].default != value}
    return ", ".join([f"`{content['kind']}`", *(f"`{name} = {toml(value)}`" for name, value in own.items())])


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


def kinds(classes: Mapping[str, Described], common: type | None = None) -> str:
    """Description of each kind, and the parameters of all, except those inherited unchanged from a common class."""
    lines = [f"- `{kind}`: {about(each)}" for kind, each in classes.items()]
    with_keys = {kind: each for kind, each in classes.items() if keys(each, common)}
    return "\n".join(lines) + (f"\n\n{parameter_table(with_keys, common)}" if with_keys else "")


def lists(classes: Iterable[Described]) -> list[str]:
    """Keys of the tables that parameters hold, alone or in lists, nested tables included."""
    holders: dict[type[msgspec.Struct], dict[str, str]] = {}  # table type -> names of the keys that hold it
    for each in (waiting := list(classes)):
        for name, parameter in keys(each).items():
            for item in binding.structs(parameter.annotation):
                waiting += [] if item in holders else [item]
                listed = typing.get_origin(parameter.annotation) is tuple
                holders.setdefault(item, {})[name] = f"each of the `{name}`" if listed else f"`{name}`"
    columns: dict[str, dict[str, type]] = {}  # per table: its title, and its possible kinds
    for item, spoken in holders.items():
        config = item.__struct_config__
        by, column = (f", by `{config.tag_field}`", str(config.tag)) if config.tag_field else ("", item.__name__.lower())
        columns.setdefault(f"Of {', '.join(spoken.values())}{by}:", {})[column] = item
    return [f"{of}\n\n{parameter_table(kinds)}" for of, kinds in columns.items()]


def parameter_table(columns: Mapping[str, Described], common: type | None = None) -> str:
    """Table of key, type, default in each class, and meaning; a key with several meanings has several rows."""
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for column, target in columns.items():
        means = first_meanings(target)
        for name, parameter in keys(target, common).items():
            if name not in means:
                raise ValueError(f"{target.__name__}.{name}: say what it means, in a comment behind it or under Args")
            words, without = said(parameter, means[name])
            row = name, type_of(name, parameter.annotation), markdown(words)
            rows.setdefault(row, {})[column] = default_of(parameter, without)
    cells = [
        [f"`{name}`", kind, *(row.get(each, ABSENT) for each in columns), means] for (name, kind, means), row in rows.items()
    ]
    return grid(["key", "type, unit", *columns, "meaning"], cells)


def grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, *rows]).replace("\n", f"\n|{'---|' * len(heads)}\n", 1)


@functools.cache
def index_text() -> str:
    """The up-to-date content of the index."""
    found: dict[str, dict[str, None]] = {}
    for path, values in _entries():
        found.setdefault(path, {}).update(dict.fromkeys(values))
    tables = {path.rpartition(".")[0] for path in found} | {each.path for each in whole().sections if each.listed} | {"vehicle"}
    return "".join("\t".join([path, *values]) + "\n" for path, values in found.items() if path not in tables)


def _entries() -> Iterator[tuple[str, list[str]]]:
    kinds = [(place.path, list(place.kinds)) for place in places() if place.kinds]
    kinds += [(each.path, [each.kind]) for each in whole().sections if each.kind and _is_set(each)]
    for path, names in kinds:
        yield from ((f"{where}.kind", names) for where in _paths(path, "kind"))
    for section in whole().sections:
        if _is_set(section):
            for key in section.keys:
                yield from ((_join(where, key.name), _values(key)) for where in _paths(section.path, key.name))


def _paths(path: str, key: str) -> list[str]:
    """Paths of the tables that may have a key of this table: agents and vehicles also have shared defaults."""
    first, _, rest = path.partition(".")
    if first == "agents":
        return [path, _join(f"{VEHICLE}.agent", rest)]
    if path == VEHICLE:
        return [path] if key in NOT_SHARED else [path, "vehicles"]
    return [path]


def _is_set(section: Section) -> bool:
    """Whether ``--set`` reaches a section: it is neither in a list of tables nor nested in one, as an obstacle's solid is."""
    return not any(each.listed and f"{section.path}.".startswith(f"{each.path}.") for each in whole().sections)


def _values(key: Key) -> list[str]:
    """Completion values of a key: its choices, or its default."""
    choice: list[Any] = key.schema.get("enum", [True, False] if key.schema.get("type") == "boolean" else [])
    words = [each if isinstance(each, str) else toml(each) for each in choice]
    if not words and isinstance(key.default, str | float | int):
        words = [key.default if isinstance(key.default, str) else toml(key.default)]
    return [word for word in words if word and not set(word) & set(" \t\n'\"")]


def _join(*parts: str) -> str:
    return ".".join(each for each in parts if each)


if __name__ == "__main__":
    main()
