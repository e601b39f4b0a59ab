"""Shell completion: what can stand next on a command line, without loading anything that simulates.

Typer knows the protocols of the shells, the commands and their options. Here is what it cannot know: scenarios, kinds, vehicles
and the keys of ``--set``, by the names of the parameters that take them. Where nothing is known, the shell completes files.
"""

import contextlib
import io
import os
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from inspect import signature
from pathlib import Path
from typing import Any

import typer
from typer.models import ParameterInfo

from vcmvsp.cosim.cli.kinds import GROUPS, PARTS
from vcmvsp.cosim.config import builtin_kinds, registry
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml

VARIABLE = "_VCMVSP_COMPLETE"
INDEX = Path(__file__).resolve().parents[1] / "reference" / "reference_keys.tsv"  # of `cosim.reference.markdown`
BREAKS = {"=", ":"}  # characters at which bash divides words
PREFIXES = {"world": "world.", "channel": "radio.", "pathloss": "radio.", "agent": "agents.", "robot": "vehicle.x.driver."}
"""Of the keys that ``--set`` means, by command; elsewhere it means keys of a scenario."""


def answer(app: typer.Typer) -> None:
    """Print what the shell asks for, and end. Whatever goes wrong, nobody wants to read it between the words that they type."""
    sys.modules["rich"] = typing.cast("Any", None)  # Typer would load it to strip markup that there is not
    _attach(app.registered_commands)
    for group in app.registered_groups:
        _attach(group.typer_instance.registered_commands if group.typer_instance else ())
    typed = _join_words() if os.environ[VARIABLE] == "complete_bash" else ""
    said, code = io.StringIO(), 1
    with contextlib.suppress(Exception), contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        try:
            app(args=[], prog_name="vcmvsp")
        except SystemExit as end:
            code = int(end.code or 0)
    if code == 0 or os.environ[VARIABLE] == "complete_fish":
        sys.stdout.writelines(f"{line.removeprefix(typed)}\n" for line in said.getvalue().splitlines() if line)
    raise SystemExit(code)


def _join_words() -> str:
    """Put together again what bash has divided at = and :; what of the present word it takes for words before it."""
    words = os.environ.get("COMP_WORDS", "").split("\n")
    count = int(os.environ.get("COMP_CWORD", "0"))
    joined: list[str] = []
    for word, before in zip(words[: count + 1], ["", *words], strict=False):
        if joined and ({word[:1], before[:1]} & BREAKS) and joined[1:]:
            joined[-1] += word
        else:
            joined.append(word)
    os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = "\n".join(joined), str(len(joined) - 1)
    present = "" if words[count : count + 1] == [] or words[count][:1] in BREAKS else words[count]
    return joined[-1].removesuffix(present) if joined else ""


def _attach(commands: Iterable[Any]) -> None:
    for command in commands:
        for parameter in signature(command.callback).parameters.values() if command.callback else ():
            for info in typing.get_args(parameter.annotation)[1:]:
                if isinstance(info, ParameterInfo) and parameter.name in COMPLETERS:
                    info.autocompletion = COMPLETERS[parameter.name]


def _scenarios(incomplete: str) -> list[str]:
    return [*sorted(path.stem for path in registry.SHIPPED.glob("*.toml")), *_files(incomplete, ".toml")]


def _worlds(incomplete: str) -> list[str]:
    return [*builtin_kinds.KINDS["world"], *_scenarios(incomplete)]


def _what(ctx: typer.Context, incomplete: str) -> list[str]:
    if ctx.info_name == "list":
        return ["scenarios", *GROUPS]
    return [*GROUPS.values(), *_scenarios(incomplete)]


def _kinds(ctx: typer.Context) -> list[str]:
    return [*builtin_kinds.KINDS.get(_first(ctx, "what"), ())]


def _vehicles(ctx: typer.Context) -> list[str]:
    return [each["name"] for each in _tables(_content(ctx), "vehicle") if isinstance(each.get("name"), str)]


def _presets() -> list[str]:
    return next(values for path, values in _index() if path == "radio.preset")


def _sections() -> list[str]:
    names = dict[str, None]()
    for path, values in _index():
        *steps, last = [each for each in path.split(".") if not each.isupper()]
        if steps and steps != ["vehicles"]:
            names[".".join(steps)] = None
        if steps and last == "kind":
            names.update({".".join([*steps, kind]): None for kind in values})
    return [*names]


def _keys(ctx: typer.Context, incomplete: str) -> list[str]:
    """The keys that begin so, down to the next dot; of the only one that is left, its values too."""
    prefix = PREFIXES.get(ctx.info_name or "", "")
    if ctx.info_name == "world" and _first(ctx, "world") not in builtin_kinds.KINDS["world"]:
        prefix = ""
    known = {key.removeprefix(prefix): values for key, values in _named(ctx, prefix + incomplete) if key.startswith(prefix)}
    key, equals, _ = incomplete.partition("=")
    if equals:
        return [f"{key}={value}" for value in known.get(key, ())]
    found = [incomplete]
    while len(found) == 1 and (found[0] == incomplete or found[0].endswith(".")):
        found = [*dict.fromkeys(_to_next_dot(each, found[0]) for each in known if each.startswith(found[0]))]
        if found == [incomplete]:
            break
    if len(found) == 1 and found[0].endswith("="):
        return [found[0], *(found[0] + value for value in known[found[0].removesuffix("=")])]
    return found


def _to_next_dot(key: str, begun: str) -> str:
    step, dot, _ = key.removeprefix(begun).partition(".")
    return f"{begun}{step}{dot or '='}"


COMPLETERS: Mapping[str, Callable[..., list[str]]] = {
    "scenario": _scenarios,
    "world": _worlds,
    "what": _what,
    "kind": _kinds,
    "vehicle": _vehicles,
    "preset": _presets,
    "section": _sections,
    "set_": _keys,
    "part": lambda: [*PARTS],
    "agents": lambda: ["inprocess", "process", "zenoh"],
}
"""By the name of the parameter."""


def _index() -> Iterator[tuple[str, list[str]]]:
    for line in INDEX.read_text("utf-8").splitlines():
        path, *values = line.split("\t")
        yield path, values


def _named(ctx: typer.Context, begun: str) -> Iterator[tuple[str, list[str]]]:
    """The same with names of the scenario's own vehicles and sensors, as far as what is typed needs them."""
    steps, content = begun.split("."), _content(ctx)
    holders = [content.get("vehicles"), *_tables(content, "vehicle")]
    sensors = [name for each in holders if isinstance(each, dict) for name in _mapping(each.get("sensors"))]
    vehicles = steps[1:2] if len(steps) > 2 else _vehicles(ctx)
    for path, values in _index():
        names = vehicles if ".NAME." in path else [""]
        own = (steps[3:4] if len(steps) > 4 else [*dict.fromkeys(sensors)]) if ".SENSOR." in path else [""]
        for name in names:
            for sensor in own:
                yield path.replace("NAME", name, 1).replace("SENSOR", sensor, 1), values


def _first(ctx: typer.Context, name: str) -> str:
    """An argument that stands on the command line already; with an option open behind it, Typer has not named it yet."""
    return str(ctx.params.get(name) or next(iter(ctx.args), ""))


def _content(ctx: typer.Context) -> dict[str, Any]:
    """The scenario that stands on the command line already, unchecked; nothing if there is none."""
    name = _first(ctx, "scenario") or _first(ctx, "world")
    shipped = registry.SHIPPED / f"{name}.toml"
    try:
        return read_toml(limits.read_text(shipped if shipped.is_file() else Path(name), limits.TOML_BYTES))
    except (OSError, ValueError):
        return {}


def _tables(content: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    found = content.get(name)
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _files(incomplete: str, suffix: str) -> list[str]:
    folder, slash, begun = incomplete.rpartition("/")
    try:
        inside = sorted(Path(f"{folder}{slash}" or ".").iterdir())
    except OSError:
        return []
    shown = [each for each in inside if each.name.startswith(begun) and not each.name.startswith(".")]
    names = {each: f"{folder}{slash}{each.name}" for each in shown}
    return [f"{name}/" if each.is_dir() else name for each, name in names.items() if each.is_dir() or each.suffix == suffix]
