"""``vcmvsp list``, ``show``, ``reference``, ``world`` and ``new``: scenarios, their kinds and keys, and templates.

``new`` fills ``$name`` and ``$Name`` into the files of ``templates/``: ``PART.toml.tmpl``, ``PART_test.py.tmpl`` and, except
for a scenario, ``PART.py.tmpl``. The result runs, and its test passes, without changes.
"""

import functools
import importlib.util
import inspect
import keyword
import os
import re
import shutil
import string
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson, Changes, changes, show_names
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import to_json
from vcmvsp.cosim.util.text import aligned, stdout_to_stderr

GROUPS = {f"{name}s": name for name in ("world", "vehicle", "sensor", "agent", "driver", "localisation")}


def list_command(
    what: Annotated[
        str, typer.Argument(metavar="[WHAT]", help="scenarios, worlds, vehicles, sensors, agents, drivers or localisations.")
    ] = "scenarios",
    json: AsJson = False,
) -> None:
    """Show the built-in scenarios, or the kinds of worlds, vehicles, sensors, agents, drivers, localisations.

    Example: vcmvsp list vehicles
    """
    from vcmvsp.cosim.config import binding, builtin_kinds, registry
    from vcmvsp.cosim.reference import describe
    from vcmvsp.cosim.scenario import loader as scenarios

    if what == "scenarios":
        about = {name: scenarios.first_words(name) for name in scenarios.names()}
    elif what in GROUPS:
        kinds = builtin_kinds.KINDS[GROUPS[what]]
        about = {kind: describe.summary(registry.find(GROUPS[what], kind)) for kind in kinds}
    else:
        raise UsageError(f"vcmvsp list {what}: {binding.unknown('word', what, ['scenarios', *GROUPS])}")
    show_names(about, json=json)


def show_command(
    what: Annotated[str, typer.Argument(metavar="SCENARIO | GROUP KIND", help="What to print.")],
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="Kind of vehicle, world, sensor ..., e.g. p2dx.")] = None,
    set_: Annotated[Changes, changes("Change a key, e.g. radio.loss.probability=0.3.")] = None,
    resolved: Annotated[bool, typer.Option("--resolved", help="Include all keys and defaults.")] = False,
    json: AsJson = False,
) -> None:
    """Print a scenario, as written or with all defaults, or the parameters of a kind.

    Example: vcmvsp show vehicle p2dx; vcmvsp show formation-circle --resolved --set radio.preset=zigbee
    """
    from vcmvsp.cosim.runs import api
    from vcmvsp.cosim.scenario import loader as scenarios

    if kind is not None or what in GROUPS.values():
        if set_ or resolved:
            raise UsageError("--set and --resolved need a scenario")
        about = parameters_of(what, kind)
        sys.stdout.write(to_json(about) if json else _text(about))
        return
    if resolved or set_ or json:
        import tomli_w

        with stdout_to_stderr():
            full = api.check(what, set=scenarios.settings_of(set_ or []))
        sys.stdout.write(to_json(full) if json else tomli_w.dumps(full))
    else:
        sys.stdout.write(scenarios.text_of(what))


def reference_command(
    section: Annotated[
        str, typer.Argument(metavar="[SECTION]", help="A table, a kind or a key, e.g. radio.loss, leader_follower, seed.")
    ] = "",
    json: AsJson = False,
    json_schema: Annotated[bool, typer.Option("--json-schema", help="Print a JSON Schema of scenarios, for editors.")] = False,
) -> None:
    """Print all keys of a scenario or of a section with type, range, default, unit and meaning.

    Example: vcmvsp reference radio.loss
    """
    from vcmvsp.cosim.reference import tree

    if json_schema:
        from vcmvsp.cosim.reference.json_schema import scenario_schema

        if section:
            raise UsageError(f"--json-schema prints the schema of a whole scenario: leave {section} out")
        sys.stdout.write(to_json(scenario_schema()))
        return
    if json:
        import msgspec

        reference = tree.Reference(sections=tuple(tree.sections_of(section)))
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(reference), indent=2).decode() + "\n")
        return
    on_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if on_terminal else None
    for number, each in enumerate(tree.sections_of(section)):
        lines = tree.lines(each, width, functools.partial(typer.style, bold=True) if on_terminal else str)
        typer.echo(("\n" if number else "") + "\n".join(lines))


def world_command(
    world: Annotated[str, typer.Argument(metavar="NAME|FILE|SCENARIO", help="A kind of world, a world file, or a scenario.")],
    png: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw it from above and in perspective [NAME.png].")
    ] = None,
    mitsuba: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write a scene for Sionna RT instead.")] = None,
    set_: Annotated[Changes, changes("A key of the world, e.g. seed=3; of a scenario: world.seed=3.")] = None,
    json: AsJson = False,
) -> None:
    """Draw a world from above and in perspective, and count its objects.

    Examples: vcmvsp world urban --set seed=3 --png city.png; vcmvsp world plant.geojson;
    vcmvsp world relay-canyon --mitsuba canyon
    """
    from vcmvsp.cosim.assembly import worlds
    from vcmvsp.cosim.scenario import loader as scenarios

    built, name = worlds.world_of(world, scenarios.settings_of(set_ or []))
    about = worlds.describe(built, name)
    if mitsuba is not None:
        about["meshes"] = worlds.write_mitsuba(built, mitsuba, **worlds.ground_of(world))
        about["scene"] = str(mitsuba / "scene.xml")
    else:
        target = png or Path(f"{name}.png")
        worlds.draw(built, target)
        about["png" if json else "picture"] = str(target)
    if json:
        sys.stdout.write(to_json(about))
    else:
        sys.stdout.writelines(f"{key:<10} {value}\n" for key, value in about.items())


def parameters_of(group: str, kind: str | None) -> dict[str, Any]:
    """Description of a kind, and unit, default and meaning of each parameter (the meaning names its source)."""
    from vcmvsp.cosim.config import binding, builtin_kinds, registry
    from vcmvsp.cosim.reference import describe

    if group not in GROUPS.values():
        raise UsageError(f"vcmvsp show {group} {kind}: {binding.unknown('word', group, GROUPS.values())}")
    if kind is None:
        raise UsageError(f"vcmvsp show {group}: which one? ({', '.join(builtin_kinds.KINDS[group])})")
    maker = registry.find(group, kind, folder=Path.cwd())
    meanings = describe.meanings(maker, joined=True)
    parameters = {
        name: {
            "type": describe.type_of(name, parameter.annotation),
            "default": binding.plain(parameter.default),
            "required": parameter.required,
            "meaning": meanings.get(name, ""),
        }
        for name, parameter in binding.parameters(maker).items()
    }
    return {"kind": kind, "summary": describe.summary(maker), "about": inspect.getdoc(maker) or "", "parameters": parameters}


def _text(about: dict[str, Any]) -> str:
    from vcmvsp.cosim.reference.describe import toml

    def default(each: dict[str, Any]) -> str:
        if each["required"]:
            return "required"
        return "none" if each["default"] is None else toml(each["default"])

    rows = [(name, default(each), each["type"], each["meaning"]) for name, each in about["parameters"].items()]
    return "\n".join([f"{about['kind']}: {about['summary']}", "", *aligned(rows), ""])


TEMPLATES = Path(__file__).resolve().parent / "templates"
PARTS: Mapping[str, str] = {
    "scenario": "three robots and the most common tables",
    "agent": "an algorithm, one object per vehicle",
    "channel": "a radio layer that loses messages",
    "vehicle": "a kind of robot with its own parameters",
    "sensor": "a sensor of a vehicle",
    "driver": "a driver of a real robot, and an emulated robot to test it",
    "task": "a task of multi-agent learning",
}
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*([-_][A-Za-z0-9]+)*")
LONGEST = 60  # characters of a name; file names are longer


def new_command(
    part: Annotated[str, typer.Argument(metavar="PART", help="scenario, agent, channel, vehicle, sensor, driver or task.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="A new name, e.g. follow-wall: the class is FollowWall.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files.")] = Path(),
) -> None:
    """Write a template with a scenario and a test; existing files are not overwritten.

    Example: vcmvsp new agent follow-wall
    """
    from vcmvsp.cosim.config import binding

    if part not in PARTS:
        raise UsageError(f"vcmvsp new {part}: {binding.unknown('part', part, PARTS)}")
    snake, camel = names_of(part, name)
    texts = rendered(part, snake, camel)
    _refuse_taken(part, snake, camel, out)
    write(texts, out)
    own = [f"the {part} {camel}", "a scenario with it"] if f"{snake}.py" in texts else [PARTS[part]]
    files = [str(out / file) for file in texts]
    rows = zip(files, [*own, "what must hold of it"], strict=True)
    sys.stdout.writelines(f"{line}\n" for line in aligned(rows))
    *_, scenario, test = files
    schema = Path(scenario).with_name("scenario.schema.json")  # the first line of the scenario names it
    sys.stdout.write(f"next: vcmvsp run {scenario}\n      pytest {test}\n")
    sys.stdout.write(f"      vcmvsp reference --json-schema > {schema}    # an editor then completes keys\n")


def names_of(part: str, name: str) -> tuple[str, str]:
    """Names of module and class: ``follow_wall`` and ``FollowWall`` for follow-wall, follow_wall or FollowWall.

    Raises:
        UsageError: the name cannot be converted.
    """
    command = f"vcmvsp new {part} {name}"
    if Path(name).name != name or "\\" in name:
        raise UsageError(f"{command}: is a path; give only a name, and the folder with --out DIR")
    if not NAME.fullmatch(name) or len(name) > LONGEST:
        words = "starts with a letter and has only letters, digits, - and _"
        raise UsageError(f"{command}: a name {words}, {LONGEST} at most, such as follow-wall")
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).replace("-", "_").lower()
    camel = "".join(each.capitalize() for each in snake.split("_"))
    if keyword.iskeyword(snake) or keyword.iskeyword(camel):
        raise UsageError(f"{command}: is a keyword of Python; choose another name, such as my-{name}")
    return snake, camel


def rendered(part: str, snake: str, camel: str) -> dict[str, str]:
    """Texts of a starting point by file name: class (not for a scenario), scenario, test."""
    sources = {f"{snake}.py": f"{part}.py", f"{snake}.toml": f"{part}.toml", f"test_{snake}.py": f"{part}_test.py"}
    texts = {}
    for file, source in sources.items():
        path = TEMPLATES / f"{source}.tmpl"
        if path.is_file():
            texts[file] = string.Template(path.read_text("utf-8")).substitute(name=snake, Name=camel)
    return texts


def write(texts: Mapping[str, str], folder: Path) -> None:
    """Write all files into a folder, created if necessary, or none."""
    from vcmvsp.cosim.util.files import writing

    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder}: is a file, not a folder")
    for file in texts:
        if os.path.lexists(folder / file):
            raise UsageError(f"{folder / file}: already exists; choose another name, or --out DIR")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in texts.items():
            with (folder / file).open("x", encoding="utf-8") as opened:
                opened.write(text)


def _refuse_taken(part: str, snake: str, camel: str, folder: Path) -> None:
    """Raise `UsageError` if a built-in kind, a module or the template's own code has this name."""
    from vcmvsp.cosim.config import builtin_kinds
    from vcmvsp.cosim.scenario import loader as scenarios

    command = f"vcmvsp new {part} {snake}"
    layers = [group for group, verb in builtin_kinds.VERBS.items() if "frame" in verb or "paths" in verb]
    groups = {"channel": layers, "scenario": [], "task": []}.get(part, [part])
    built_in = [kind for group in groups for kind in builtin_kinds.KINDS[group]]
    if part == "scenario":
        built_in = scenarios.names()
    if snake in {each.replace("-", "_") for each in built_in}:
        raise UsageError(f"{command}: a built-in {part} has this name; choose another one, such as my-{snake}")
    if part == "scenario":
        return
    if part == "channel" and snake == "received":  # in recordings the name of the outcome "not lost"
        raise UsageError(f"{command}: losses with this cause would count as received; choose another name, such as my-{snake}")
    spec = importlib.util.find_spec(snake)
    if spec is not None and spec.origin != str((folder / f"{snake}.py").resolve()):
        raise UsageError(
            f"{command}: {snake}.py would hide a module of Python or vcmvsp; choose another name, such as my-{snake}"
        )
    templates = "".join((TEMPLATES / f"{each}.py.tmpl").read_text("utf-8") for each in (part, f"{part}_test"))
    if re.search(rf"\b{camel}\b", templates):
        raise UsageError(f"{command}: the template already uses '{camel}'; choose another name, such as my-{snake}")
