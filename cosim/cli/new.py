"""``vcmvsp new``: a starting point of one's own, which runs as it is, with a test that passes as it is.

What is written stands in ``templates/``, but for ``$name`` and ``$Name``: ``PART.toml.tmpl``, ``PART_test.py.tmpl`` and,
unless it is a scenario, ``PART.py.tmpl``.
"""

import importlib.util
import keyword
import os
import re
import string
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.errors import UsageError

TEMPLATES = Path(__file__).resolve().parent / "templates"
PARTS: Mapping[str, str] = {
    "scenario": "three robots and the tables that people change",
    "agent": "an algorithm, one object per vehicle",
    "channel": "a layer of the radio that loses messages",
    "vehicle": "a kind of robot with numbers of its own",
    "sensor": "something else that a vehicle carries",
    "driver": "the way to a real robot, and a robot in software to try it on",
}
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*([-_][A-Za-z0-9]+)*")
LONGEST = 60  # letters of a name: its files have longer ones


def new_command(
    part: Annotated[str, typer.Argument(metavar="PART", help="scenario, agent, channel, vehicle, sensor or driver.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of your own, e.g. follow-wall: its class is FollowWall.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write it.")] = Path(),
) -> None:
    """Write a starting point of your own, with a scenario and a test; nothing is overwritten.

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
    width = max(map(len, files))
    sys.stdout.writelines(
        f"{file:<{width}}  {words}\n" for file, words in zip(files, [*own, "what must hold of it"], strict=True)
    )
    *_, scenario, test = files
    sys.stdout.write(f"next: vcmvsp run {scenario}\n      pytest {test}\n")


def names_of(part: str, name: str) -> tuple[str, str]:
    """The names of module and class: ``follow_wall`` and ``FollowWall`` of follow-wall, follow_wall or FollowWall.

    Raises:
        UsageError: no such names can be made of it.
    """
    here = f"vcmvsp new {part} {name}"
    if Path(name).name != name or "\\" in name:
        raise UsageError(f"{here}: is a path; give a name, and the folder with --out DIR")
    if not NAME.fullmatch(name) or len(name) > LONGEST:
        words = "begins with a letter and has letters, digits, - and _ only"
        raise UsageError(f"{here}: a name {words}, {LONGEST} at most, such as follow-wall")
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).replace("-", "_").lower()
    camel = "".join(each.capitalize() for each in snake.split("_"))
    if keyword.iskeyword(snake) or keyword.iskeyword(camel):
        raise UsageError(f"{here}: is a word of Python; give another name, such as my-{name}")
    return snake, camel


def rendered(part: str, snake: str, camel: str) -> dict[str, str]:
    """The texts of a starting point, by the names of the files that they belong into: class if it has one, scenario, test."""
    sources = {f"{snake}.py": f"{part}.py", f"{snake}.toml": f"{part}.toml", f"test_{snake}.py": f"{part}_test.py"}
    texts = {}
    for file, source in sources.items():
        path = TEMPLATES / f"{source}.tmpl"
        if path.is_file():
            texts[file] = string.Template(path.read_text("utf-8")).substitute(name=snake, Name=camel)
    return texts


def write(texts: Mapping[str, str], folder: Path) -> None:
    """Write all of it into a folder, which is made if need be, or nothing."""
    from vcmvsp.cosim.util.files import writing

    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder}: is a file, not a folder")
    for file in texts:
        if os.path.lexists(folder / file):
            raise UsageError(f"{folder / file}: is there already, and stays as it is; give another name, or --out DIR")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in texts.items():
            with (folder / file).open("x", encoding="utf-8") as opened:
                opened.write(text)


def _refuse_taken(part: str, snake: str, camel: str, folder: Path) -> None:
    """Names that mean something else already, where they are to stand."""
    from vcmvsp.cosim.config import builtin_kinds
    from vcmvsp.cosim.scenario import loader as scenarios

    here = f"vcmvsp new {part} {snake}"
    layers = [group for group, verb in builtin_kinds.VERBS.items() if "frame" in verb or "paths" in verb]
    groups = {"channel": layers, "scenario": []}.get(part, [part])
    built_in = scenarios.names() if part == "scenario" else [kind for group in groups for kind in builtin_kinds.KINDS[group]]
    if snake in {each.replace("-", "_") for each in built_in}:
        raise UsageError(f"{here}: there is a built-in {part} of that name; give another one, such as my-{snake}")
    if part == "scenario":
        return
    if part == "channel" and snake == "received":  # recordings call by this name what is not lost
        raise UsageError(f"{here}: losses would count as received; give another name, such as my-{snake}")
    spec = importlib.util.find_spec(snake)
    if spec is not None and spec.origin != str((folder / f"{snake}.py").resolve()):
        raise UsageError(
            f"{here}: {snake}.py would hide a module that Python or vcmvsp has; give another name, such as my-{snake}"
        )
    used = "".join((TEMPLATES / f"{each}.py.tmpl").read_text("utf-8") for each in (part, f"{part}_test"))
    if re.search(rf"\b{camel}\b", used):
        raise UsageError(f"{here}: its file uses '{camel}' for something else; give another name, such as my-{snake}")
