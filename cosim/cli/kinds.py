"""``vcmvsp list``, ``show``, ``reference`` and ``world``: what scenarios are made of."""

import inspect
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import to_json
from vcmvsp.cosim.util.text import stdout_to_stderr

GROUPS = {f"{name}s": name for name in ("world", "vehicle", "sensor", "agent", "driver", "localisation")}
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a key, e.g. radio.loss.probability=0.3.")
]


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
    if json:
        sys.stdout.write(to_json(about))
    else:
        width = max(map(len, about))
        sys.stdout.writelines(f"{name:<{width}}  {words}\n" for name, words in about.items())


def show_command(
    what: Annotated[str, typer.Argument(metavar="SCENARIO | GROUP KIND", help="What to print.")],
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="Of a vehicle, world, sensor, ..., e.g. p2dx.")] = None,
    set_: Sets = None,
    resolved: Annotated[bool, typer.Option("--resolved", help="With every key and default filled in.")] = False,
    json: AsJson = False,
) -> None:
    """Print a scenario as it is written, or with everything filled in; or every parameter of a kind.

    Example: vcmvsp show vehicle p2dx; vcmvsp show formation-circle --resolved --set radio.preset=zigbee
    """
    from vcmvsp.cosim.runs import api
    from vcmvsp.cosim.scenario import loader as scenarios

    if kind is not None or what in GROUPS.values():
        if set_ or resolved:
            raise UsageError("--set and --resolved go with a scenario")
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
    """Print every key of a scenario, or those of a section: type and range, default, unit, meaning.

    Example: vcmvsp reference radio.loss
    """
    from vcmvsp.cosim.reference import tree

    if json_schema:
        from vcmvsp.cosim.reference.json_schema import scenario_schema

        if section:
            raise UsageError(f"--json-schema is about a whole scenario: leave {section} out")
        sys.stdout.write(to_json(scenario_schema()))
        return
    if json:
        import msgspec

        found = tree.Reference(sections=tuple(tree.asked(section)))
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(found), indent=2).decode() + "\n")
        return
    on_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if on_terminal else None
    for number, each in enumerate(tree.asked(section)):
        shown = tree.lines(each, width, _strong if on_terminal else str)
        typer.echo(("\n" if number else "") + "\n".join(shown))


def world_command(
    world: Annotated[str, typer.Argument(metavar="NAME|FILE|SCENARIO", help="A kind of world, a file of one, or a scenario.")],
    png: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw it from above and in perspective [NAME.png].")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A key of the world, e.g. seed=3; of a scenario: world.seed=3."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Draw a world from above and in perspective, and count what is in it.

    Examples: vcmvsp world urban --set seed=3 --png city.png; vcmvsp world plant.geojson
    """
    from vcmvsp.cosim.assembly import worlds
    from vcmvsp.cosim.scenario import loader as scenarios

    built, name = worlds.world_of(world, scenarios.settings_of(set_ or []))
    about = worlds.describe(built, name)
    target = png or Path(f"{name}.png")
    worlds.draw(built, target)
    if json:
        sys.stdout.write(to_json({**about, "png": str(target)}))
    else:
        sys.stdout.writelines(f"{key:<10} {value}\n" for key, value in {**about, "picture": target}.items())


def parameters_of(group: str, kind: str | None) -> dict[str, Any]:
    """A kind: what it is, and each parameter with unit, default and meaning (which names its source)."""
    from vcmvsp.cosim.config import binding, builtin_kinds, registry
    from vcmvsp.cosim.reference import describe

    if group not in GROUPS.values():
        raise UsageError(f"vcmvsp show {group} {kind}: {binding.unknown('word', group, GROUPS.values())}")
    if kind is None:
        raise UsageError(f"vcmvsp show {group}: which one? ({', '.join(builtin_kinds.KINDS[group])})")
    found = registry.find(group, kind, folder=Path.cwd())
    means = describe.meanings(found, joined=True)
    parameters = {
        name: {
            "type": describe.type_of(name, parameter.annotation),
            "default": None if parameter.required else binding.plain(parameter.default),
            "required": parameter.required,
            "meaning": means.get(name, ""),
        }
        for name, parameter in binding.parameters(found).items()
    }
    return {"kind": kind, "summary": describe.summary(found), "about": inspect.getdoc(found) or "", "parameters": parameters}


def _text(about: dict[str, Any]) -> str:
    """The parameters as lines."""
    from vcmvsp.cosim.reference.describe import toml

    rows = [
        (
            name,
            "required" if each["required"] else "none" if each["default"] is None else toml(each["default"]),
            each["type"],
            each["meaning"],
        )
        for name, each in about["parameters"].items()
    ]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(3)]
    lines = [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row[:3], widths, strict=True)), row[3]]).rstrip() for row in rows
    ]
    return "\n".join([f"{about['kind']}: {about['summary']}", "", *lines, ""])


def _strong(word: str) -> str:
    return typer.style(word, bold=True)
