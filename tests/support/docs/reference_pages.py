"""Generated parts of ``docs/reference``: public names, commands, and fields of recorded values.

A block is between ``<!-- generated: NAME -->`` and ``<!-- end -->``, as in the pages of keys (`cosim.reference.markdown`):
that module lies below the command line and the front door, and therefore cannot write these.
"""

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import vcmvsp
from tests.support.paths import ROOT
from vcmvsp.cosim import testing, types
from vcmvsp.cosim.cli import app as cli
from vcmvsp.cosim.recording.mcap_writer import FRAME
from vcmvsp.cosim.reference.describe import meanings
from vcmvsp.cosim.reference.markdown import grid
from vcmvsp.cosim.tables.schema import ERRORS_SCHEMA, NOTES_SCHEMA, PATHS_SCHEMA, RADIO_SCHEMA, STATES_SCHEMA

FOLDER = ROOT / "docs" / "reference"
COMMAND = "python -m tests.support.docs.reference_pages --write"

API: Mapping[str, tuple[str, ...]] = {
    "Agent": ("Agent", "Observation", "Radio", "VehicleInfo"),
    "Messages": ("ReceivedMessages", "Reception", "Message"),
    "Commands": ("Velocity", "Waypoint"),
    "State and readings": ("VehicleState", "Odometry", "Fix", "Imu", "Scan", "Image", "Measured"),
    "Formation error": ("Follows",),
    "Runs from Python": ("run", "study", "Result", "start", "SteppedRun"),
    "Types for constructor parameters": ("Positive", "NonNegative", "Probability"),
    "Angles and frames": ("wrap", "arc", "rotate2", "yaw_of", "quaternion_from_yaw"),
    "Errors": ("VcmvspError", "ScenarioError", "UsageError", "FederateError", "AgentError", "Interrupted"),
    "Checks (`vcmvsp.cosim.testing`)": ("check_agent", "check_channel", "check_federate"),
}
"""Names of the front door, by topic, and the checks."""

TOPICS: Mapping[str, str] = {
    "state": "VehicleState",
    "command": "Velocity",
    "send": "Message",
    "heard": "Heard",
    "note": "Note",
    "follows": "Follows",
    "presence": "Presence",
    "odometry": "Odometry",
    "fix": "Fix",
    "real": "RealStatus",
    "incident": "Incident",
    "SENSOR": "Scan",
}
"""Values under ``<vehicle>/NAME`` in ``run.mcap``; of several types the one that is explained."""

STATES = {
    "time_ns": "ns since the start of the run",
    "vehicle": "name of the vehicle",
    **dict.fromkeys("xyz", "position, m, world"),
    **dict.fromkeys(("qw", "qx", "qy", "qz"), "attitude (world_from_body), unit quaternion"),
    **dict.fromkeys(("vx", "vy", "vz"), "velocity, m/s, world"),
    **dict.fromkeys(("wx", "wy", "wz"), "angular velocity, rad/s, body"),
    "yaw": "direction of the body x axis seen from above, rad",
}
ERRORS = {
    **STATES,
    "vehicle": "name of the follower",
    "leader": "name of its leader",
    "error_m": "distance of its handle from its slot, m",
    "ahead_m": "distance of the slot ahead of the handle, m, in the follower's frame",
    "left_m": "distance of the slot to the left of the handle, m, in the follower's frame",
}
NOTES = {
    **STATES,
    "name": "name of the note",
    "value": "noted number; true: 1, false: 0; null: a text",
    "text": "noted text; empty: a number",
}
RADIO = {
    "copy_ns": "time of reception of a second copy, ns since the start of the run; null: none",
    "receiver": "name of the addressed vehicle",
    "received_ns": "time of reception, ns since the start of the run; null: not received",
    "delay_ns": "`received_ns - sent_ns`, ns; null: not received",
}


def markdown(text: str) -> str:
    """A docstring's paragraph on one line, with Markdown's marks for code."""
    return re.sub(r"(?<!`)``(?!`)", "`", " ".join(text.split()))


def parts_of(target: object) -> tuple[str, str]:
    """The paragraphs of a docstring before its sections, and the sections."""
    text = inspect.getdoc(target) or ""
    head = re.split(r"^(?:Args|Attributes|Returns|Raises):\n", text, maxsplit=1, flags=re.MULTILINE)[0]
    paragraphs = [
        markdown(each) for each in head.split("\n\n") if each.strip() and "::" not in each and not each.startswith("    ")
    ]
    return "\n\n".join(paragraphs), text[len(head) :]


def node_of(target: Any) -> Any:
    """The definition of a class or a function."""
    return ast.parse(textwrap.dedent(inspect.getsource(target))).body[0]


def signature(name: str, node: ast.FunctionDef) -> str:
    """Name and parameters, without annotations."""
    bare = ast.arguments(
        **{
            field: [ast.arg(each.arg) for each in getattr(node.args, field) if each.arg not in {"self", "cls"}]
            for field in ("posonlyargs", "args", "kwonlyargs")
        },
        vararg=node.args.vararg and ast.arg(node.args.vararg.arg),
        kwarg=node.args.kwarg and ast.arg(node.args.kwarg.arg),
        defaults=node.args.defaults,
        kw_defaults=node.args.kw_defaults,
    )
    return f"{name}({ast.unparse(bare)})"


def fields(target: Any) -> str:
    """The annotated attributes of a class and those in its docstring: type, default, meaning."""
    known, rows = dict(meanings(target)), []
    for each in node_of(target).body:
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name) and not each.target.id.startswith("_"):
            name, value = each.target.id, "required" if each.value is None else f"`{ast.unparse(each.value)}`"
            value = "none" if "msgspec.field" in value else value
            rows.append([f"`{name}`", f"`{ast.unparse(each.annotation)}`".replace("|", "\\|"), value, known.get(name, "")])
    listed = re.search(r"^Attributes:\n((?: .*\n?)*)", inspect.getdoc(target) or "", re.MULTILINE)
    explanations = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", listed[1] if listed else "", re.MULTILINE)
    named = {row[0] for row in rows}
    rows += [[f"`{name}`", "", "", markdown(words)] for name, words in explanations if f"`{name}`" not in named]
    table = [[name, kind, value, markdown(words).replace("|", "\\|")] for name, kind, value, words in rows]
    return grid(["attribute", "type", "default", "meaning"], table) if table else ""


def methods(target: Any) -> list[str]:
    """A line for each public method and property."""
    lines, explained = list[str](), list[str]()
    for each in node_of(target).body:
        if isinstance(each, ast.FunctionDef) and not each.name.startswith(("_", "drain")):
            is_property = any(ast.unparse(mark) == "property" for mark in each.decorator_list)
            words = markdown((ast.get_docstring(each) or "").partition("\n\nArgs:")[0].partition("\n\nRaises:")[0])
            shown = each.name if is_property else signature(each.name, each)
            lines.append(f"- `{shown}`: {words}")
            explained += [
                f"- `{each.name}({name}=)`: {explanation}" for name, explanation in arguments(ast.get_docstring(each) or "")
            ]
    return [*lines, "", *explained] if explained else lines


def arguments(docstring: str) -> list[tuple[str, str]]:
    """The parameters that a docstring explains."""
    section = re.search(r"^Args:\n((?: .*\n?)*)", docstring, re.MULTILINE)
    entries = re.findall(r"^ {4}(\w[\w, ]*): (.*(?:\n {8}.*)*)", section[1] if section else "", re.MULTILINE)
    return [(name, markdown(words)) for name, words in entries]


def entry(name: str) -> Iterator[str]:
    """The page's text on a name."""
    target = getattr(testing if name.startswith("check_") else vcmvsp, name)
    yield f"### `{name}`"
    if inspect.isfunction(target):
        yield f"`{signature(name, node_of(target))}`"
        yield parts_of(target)[0]
        yield "\n".join(f"- `{each}`: {words}" for each, words in arguments(inspect.getdoc(target) or ""))
        for title in ("Returns", "Raises"):
            found = re.search(rf"^{title}:\n((?: .*\n?)*)", inspect.getdoc(target) or "", re.MULTILINE)
            if found:
                yield f"{title}: {markdown(found[1])}"
    elif inspect.isclass(target):
        yield parts_of(target)[0]
        yield fields(target)
        yield "\n".join(methods(target))
    else:
        bounds = target.__metadata__[0]
        limits = [
            f"at least {bounds.ge:g}" if bounds.ge is not None else "",
            f"above {bounds.gt:g}" if bounds.gt is not None else "",
        ]
        limits.append(f"at most {bounds.le:g}" if bounds.le is not None else "")
        yield f"A `float`, {', '.join(filter(None, limits))}: a scenario's value is checked against it."


def api() -> str:
    """Every name of the front door."""
    found: list[str] = []
    for topic, names in API.items():
        found.append(f"## {topic}")
        for name in names:
            found += [each for each in entry(name) if each]
    return "\n\n".join(found)


def topics() -> str:
    """Fields of the values under a vehicle's topics."""
    found = []
    for topic, name in TOPICS.items():
        target = getattr(types, name)
        found += [f"### `<vehicle>/{topic}`", f"`vcmvsp.{name}`: {parts_of(target)[0]}", fields(target)]
    return "\n\n".join(found)


def columns() -> str:
    """Columns of the tables."""
    frame = {**FRAME, **RADIO}
    found = []
    tables = (
        ("states.parquet", STATES_SCHEMA, STATES),
        ("radio.parquet", [*RADIO_SCHEMA, *PATHS_SCHEMA], frame),
        ("errors.parquet", ERRORS_SCHEMA, ERRORS),
        ("Result.notes", NOTES_SCHEMA, NOTES),
    )
    for title, schema, words in tables:
        rows = [
            [
                f"`{each.name}`",
                str(each.type).replace("dictionary<values=string, indices=int32, ordered=0>", "string"),
                words[each.name],
            ]
            for each in schema
        ]
        found += [f"### `{title}`", grid(["column", "type", "meaning"], rows)]
    return "\n\n".join(found)


def commands() -> str:
    """Every command with its options, as ``--help`` has them."""
    return "\n\n".join(_commands("vcmvsp", cli.command()))


def _commands(name: str, command: Any) -> Iterator[str]:
    if hasattr(command, "commands"):
        for each, inner in command.commands.items():
            if not inner.hidden:
                yield from _commands(f"{name} {each}", inner)
        return
    yield f"## `{name}`"
    for paragraph in (command.help or "").split("\n\n"):
        words = " ".join(paragraph.replace("\b", "").split())
        example, _, line = words.partition("Example: ")
        yield f"{example}Example: `{line}`" if line else re.sub(r"(?<![\w`])'(vcmvsp [^']+)'", r"`\1`", words)
    rows = []
    for each in command.params:
        if getattr(each, "hidden", False):
            continue
        shown = (
            [f"{opt}{f' {each.metavar}' if each.metavar else ''}" for opt in each.opts]
            if each.param_type_name == "option"
            else [(each.metavar or each.name.upper())]
        )
        rows.append([", ".join(f"`{opt}`" for opt in shown), " ".join((each.help or "").split()).replace("|", "\\|")])
    if rows:
        yield grid(["argument, option", "meaning"], rows)


BLOCKS: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "author-api.md": {"api": api},
    "topics.md": {"topics": topics, "columns": columns},
    "commands.md": {"commands": commands},
}
"""By page and name of the block."""


def page_with_blocks(name: str, page: str) -> str:
    """The page of this name, with blocks generated from the code."""
    for block, write in BLOCKS[name].items():
        before, begin, rest = page.partition(f"<!-- generated: {block} -->\n")
        _, end, after = rest.partition("<!-- end -->\n")
        if not end:
            raise ValueError(f"{name} has no block '<!-- generated: {block} -->' ... '<!-- end -->'")
        page = f"{before}{begin}\n{write()}\n\n{end}{after}"
    return page


def main() -> None:
    """Write the pages."""
    if sys.argv[1:] != ["--write"]:
        sys.exit(f"usage: {COMMAND}")
    for name in BLOCKS:
        path: Path = FOLDER / name
        path.write_text(page_with_blocks(name, path.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
