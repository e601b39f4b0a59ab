"""The reference of the radio's keys, written from the code: ``python -m cosim.reference --write``.

Between two comments of ``scenarios/README.md`` stands what this module makes of signatures (types, ranges, defaults),
docstrings and comments (`cosim.meanings`): what a key means is said where its type and default are, and nowhere else.
"""

import argparse
import inspect
import json
import math
import re
import sys
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cosim import registry, table
from cosim.meanings import meanings, summary
from cosim.scenario import BUILT_IN

PAGE = BUILT_IN / "README.md"
UPDATE = "python -m cosim.reference --write"
OFFERED = ("sightline", "noise_dbm")
"""Parameters of layers that come from the rest of the scenario (`cosim.radio.build`), not from a key."""

ABSENT = "–"  # this kind takes no such key
RANGE_BYTES = 100

_UNITS = {
    "_per_s": "1/s",
    "_s": "s",
    "seconds": "s",
    "_us": "us",
    "_m": "m",
    "_hz": "Hz",
    "_bps": "bit/s",
    "_db": "dB",
    "_dbm": "dBm",
    "_dbi": "dBi",
}


# --- the page -----------------------------------------------------------------------------------------------------------------


def updated(page: str) -> str:
    """The page with the present reference between each ``<!-- generated: NAME -->`` and the next ``<!-- end -->``."""
    for name, write in BLOCKS.items():
        before, begin, rest = page.partition(f"<!-- generated: {name} -->\n")
        _, end, after = rest.partition("<!-- end -->\n")
        if not end:
            raise ValueError(f"the page has no block '<!-- generated: {name} -->' ... '<!-- end -->'")
        page = f"{before}{begin}\n{write()}\n\n{end}{after}"
    return page


def main(arguments: Sequence[str] | None = None, page: Path = PAGE) -> None:
    """Bring the page up to date, or say that it is not."""
    parser = argparse.ArgumentParser(prog="python -m cosim.reference", description="The reference of [radio], from the code.")
    parser.add_argument("--write", action="store_true", help="update the page instead of checking it")
    write: bool = parser.parse_args(arguments).write
    old = page.read_text("utf-8")
    new = updated(old)
    if write:
        page.write_text(new, "utf-8")
    elif new != old:
        sys.exit(f"{page} is not what the code says; update it: {UPDATE}")


# --- blocks -------------------------------------------------------------------------------------------------------------------


def radio() -> str:
    """Layers, presets, and a table of parameters for each layer."""
    presets = registry.piece("radio presets")
    parts = [_layers(presets.LAYERS), _presets(presets)]
    for layer in presets.LAYERS:
        classes = {kind: registry.find(layer, kind) for kind in registry.KINDS[layer]}
        parts += [f"#### `[radio.{layer}]`", kinds(classes), *lists(classes.values())]
    return "\n\n".join(parts)


def vehicle_radio() -> str:
    """The parameters of a vehicle's own radio."""
    return parameter_table({"default": registry.piece("vehicle radio")})


BLOCKS: Mapping[str, Callable[[], str]] = {"radio": radio, "vehicle radio": vehicle_radio}


def _layers(layers: Sequence[str]) -> str:
    """What each layer is about: the first words of the module that defines its first kind."""
    rows = []
    for layer in layers:
        kinds_of = registry.KINDS[layer]
        about = inspect.getmodule(registry.find(layer, next(iter(kinds_of))))
        rows.append([f"`{layer}`", markdown(summary(about)), ", ".join(f"`{kind}`" for kind in kinds_of)])
    return grid(["layer", "what it is about", "kinds"], rows)


def _presets(presets: Any) -> str:
    """What each preset sets beyond the defaults of its kinds, and how far it reaches."""
    tables = {name: presets.preset(name) for name in presets.PRESETS}
    first = tables[presets.PRESETS[0]]
    alike = [layer for layer in presets.LAYERS if all(each[layer] == first[layer] for each in tables.values())]
    differ = [layer for layer in presets.LAYERS if layer not in alike]
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
    known = table.parameters(registry.find(layer, content["kind"]))
    own = {name: value for name, value in _params(content).items() if known[name].required or known[name].default != value}
    return ", ".join([f"`{content['kind']}`", *(f"`{name} = {toml(value)}`" for name, value in own.items())])


def reach_m(preset: Mapping[str, Mapping[str, Any]]) -> float:
    """Where the level is the least at which half of all frames are received: ``d0 10^((P - L0 - S) / (10 N))``.

    S is the sensitivity or, where that is more, the level that the preamble's or the payload's ratio to the noise needs.
    """
    law, mac = _complete("path_loss", preset), _complete("mac", preset)
    if law["kind"] != "log_distance":
        return math.inf if law["kind"] == "none" else math.nan
    phy = table.call(registry.find("phy", preset["phy"]["kind"]), _params(preset["phy"]))
    noise_dbm, errors = getattr(phy, "noise_dbm", -math.inf), getattr(phy, "errors", None)
    snr_db = mac.get("preamble_snr_db", getattr(phy, "preamble_snr_db", -math.inf))
    if errors is not None:
        ratios_db = np.arange(-20.0, 40.0, 1e-3)
        snr_db = max(snr_db, ratios_db[np.argmax(errors.frame_success(ratios_db, RANGE_BYTES) >= 0.5)])
    sensitivity_dbm = -math.inf if mac["kind"] == "csma154" else phy.sensitivity_dbm  # there it is no threshold
    margin_db = phy.tx_power_dbm - law["reference_loss_db"] - max(sensitivity_dbm, noise_dbm + snr_db)
    return float(law["reference_distance_m"] * 10.0 ** (margin_db / (10.0 * law["exponent"])))


def _complete(layer: str, preset: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    content = preset[layer]
    return {**content, **table.complete(registry.find(layer, content["kind"]), _params(content))}


def _params(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name != "kind"}


def _length(metres: float) -> str:
    if not math.isfinite(metres):
        return ABSENT if math.isnan(metres) else "unlimited"
    return f"{metres:.1f} m" if metres < 1000.0 else f"{metres / 1000.0:.1f} km"


# --- tables of parameters -----------------------------------------------------------------------------------------------------


def kinds(classes: Mapping[str, Any]) -> str:
    """What each kind is, and the parameters of them all."""
    lines = [f"- `{kind}`: {markdown(summary(each))}" for kind, each in classes.items()]
    with_keys = {kind: each for kind, each in classes.items() if keys(each)}
    return "\n".join(lines) + (f"\n\n{parameter_table(with_keys)}" if with_keys else "")


def lists(classes: Iterable[Any]) -> list[str]:
    """For each parameter that is a list of tables, the keys of such a table."""
    found = {name: item for each in classes for name, parameter in keys(each).items() for item in structs(parameter.annotation)}
    return [f"Of each of the `{name}`:\n\n{parameter_table({item.__name__.lower(): item})}" for name, item in found.items()]


def parameter_table(columns: Mapping[str, Any]) -> str:
    """Key, type, default for each class, meaning; a key that means different things has several rows."""
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for column, target in columns.items():
        means = meanings(target)
        for name, parameter in keys(target).items():
            if name not in means:
                raise ValueError(f"{target.__name__}.{name}: say what it means, in a comment behind it or under Args")
            words, _, without = means[name].partition("None: ")
            row = name, type_of(name, parameter.annotation), markdown(words.rstrip("; "))
            rows.setdefault(row, {})[column] = default_of(parameter, without)
    cells = [
        [f"`{name}`", kind, *(row.get(each, ABSENT) for each in columns), means] for (name, kind, means), row in rows.items()
    ]
    return grid(["key", "type, unit", *columns, "meaning"], cells)


def keys(target: Any) -> dict[str, table.Parameter]:
    """The parameters that a scenario can give."""
    return {name: each for name, each in table.parameters(target).items() if name not in OFFERED}


def structs(annotation: Any) -> list[type[msgspec.Struct]]:
    """The tables that a value of this annotation consists of."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [each for inner in typing.get_args(annotation) for each in structs(inner)]


def type_of(name: str, annotation: Any) -> str:
    """Unit, by the end of the name, and what values are allowed."""
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    words = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", table.describe(annotation))
    words = "list of tables: see below" if structs(annotation) else _short(words)
    words = re.sub(r"^a number ?", "", words) if unit or words != "a number" else words
    return ", ".join(filter(None, [unit, words.removeprefix("a ")]))


def _short(numbers: str) -> str:
    """Numbers without what their exponents need not have: 1e+09 is 1e9."""
    return re.sub(r"(?<=\d)[eE]\+?(-?)0*(?=\d)", r"e\1", numbers)


def default_of(parameter: table.Parameter, without: str) -> str:
    """``required``, the default as TOML or, where that is None, what then holds."""
    if parameter.required:
        return "required"
    return markdown(without or "none") if parameter.default is None else f"`{toml(table.plain(parameter.default))}`"


def toml(value: Any) -> str:
    """A value as it can be written in a scenario."""
    if isinstance(value, float):
        return _short(Decimal(repr(value)).normalize().to_eng_string() if abs(value) >= 1e5 else repr(value))
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{name} = {toml(each)}' for name, each in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, *rows]).replace("\n", f"\n|{'---|' * len(heads)}\n", 1)


def markdown(text: str) -> str:
    """Text of a docstring: code has single quotes there."""
    return text.replace("``", "`")


if __name__ == "__main__":
    main()
