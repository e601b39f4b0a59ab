"""Cases of the fuzzer: files, and a command that reads them. A seed and a number say all of a case.

Scenarios are those of the gallery and a small one, changed in their keys or in their text; results are those of a short run,
with a file that is cut, garbled, replaced or gone; command lines are drawn from the commands' own options.
"""

import random
import shutil
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import tomli_w

from tests.support.paths import SCENARIOS
from vcmvsp.cosim.cli.app import command
from vcmvsp.cosim.reference.markdown import INDEX

SMALL = """
name = "small"
duration_s = 0.5
physics.kind = "kinematic"
radio.preset = "wifi-g-6"
[[vehicle]]
name = "car1"
kind = "p2dx"
agent = { kind = "trajectory", path = "circle" }
sensors.gps = { kind = "gps" }
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-1.0, -0.5, 0.0]
agent = { kind = "leader_follower", leader = "car1" }
"""
HOSTILE = (
    f"x = {'9' * 5000}",
    f"x = {'[' * 100_000}",
    f"x = {'{a=' * 20_000}",
    f"{'a.' * 50_000}a = 1",
    f"[{'a.' * 2000}a]",
    "include = 'loop'",
    "world = { kind = 'mesh', file = 'loop' }",
    f"{'n' * 300_000} = 1",
    f"[[vehicle]]\nname = '{'n' * 300}'\ncount = 100000",
)
"""Lines of a scenario: beyond what parsers and structures bear."""
LOOP = "loop"  # a link to itself, in the folder of each case
SHORT = ("--set", "duration_s=0.2", "--set", "record.interval_s=0.1")
GALLERY = sorted(SCENARIOS.glob("*.toml"))
KEYS = [line.split("\t") for line in INDEX.read_text("utf-8").splitlines()]
VALUES: list[Any] = [
    *(0, -1, 1, 3, 2**31, 2**63 - 1, 1e-12, 0.5, -0.0, 1e9, 1e308, float("nan"), float("inf"), float("-inf")),
    *(
        "",
        "car1",
        "nobody",
        "own.py:Nothing",
        "no.such.module:Class",
        ":",
        "../up",
        ".",
        "a\0b",
        "ä\u202e\U0001f697",
        "x" * 5000,
        LOOP,
        f"{LOOP}/x.py:Class",
    ),
    *(True, False, [], {}, [[]], [{}], [0.0], [1.0, 2.0, 3.0], [float("nan")] * 3, ["car1", "car1"], {"kind": "none"}),
    *({"kind": 1}, {"": 0}, {"a": {"b": {"c": [1]}}}),
]
WORDS = (
    "",
    "-1",
    "0",
    "3",
    "1e400",
    "nan",
    "1:2:0",
    "0:1:0.5",
    "5:1:1",
    "car1",
    "car1/car2",
    "*/*",
    "wifi-g-6",
    "ideal",
    "v=1",
    "a,b",
    LOOP,
    "9" * 5000,
    "x" * 5000,
    f"{'a.' * 5000}a=1",
    f"a={'[' * 50_000}",
)
SAFE = ["calibrate", "channel", "check", "drive", "export", "list", "new", "pathloss", "per", "plot", "radio", "reference"]
SAFE += ["report", "run", "show", "study", "world"]
DOERS = (
    "--view",
    "--view-host",
    "--view-port",
    "--cluster",
    "--listen",
    "--agents",
    "--install-completion",
    "--realtime",
    "--jobs",
)
FOLDERS = ("calibrate", "export", "new", "plot", "replay", "run", "study")
OUTPUTS = {
    **dict.fromkeys(FOLDERS, ("--out", "out")),
    "report": ("--out", "out.html"),
    "channel": ("--out", "out.parquet"),
    "world": ("--png", "out.png"),
}
RESULTS = (
    *(
        ["report", "results", "--out", "out.html"],
        ["plot", "results", "--out", "out"],
        ["radio", "results"],
        ["radio", "results", "--frame", "1"],
    ),
    *(["export", "results", "--csv", "--out", "out"], ["export", "results", "--layout", "--rosbag2", "--out", "out"]),
    *(
        ["replay", "results", "--out", "out"],
        ["radio", "results", "--frame", "lost", "--json"],
        ["show", "results/scenario.toml"],
    ),
)
COMMANDS: dict[str, Any] = command().commands

Case = list[str]  # the words of a command; its files are in the folder


def make(number: int, seed: int, folder: Path, results: Path) -> Case:
    """Write the files of a case into its folder, and give its command; ``results`` are those of a whole run."""
    draw = random.Random(f"{seed}/{number}")
    (folder / LOOP).symlink_to(LOOP)
    kinds: list[Callable[[random.Random, Path, Path], Case]] = [changed_scenario, changed_text, changed_sets]
    return draw.choice([*kinds, changed_results, changed_results, command_line])(draw, folder, results)


def changed_scenario(draw: random.Random, folder: Path, results: Path) -> Case:
    """A scenario with a few keys that are others, gone, moved, or new."""
    tables = tomllib.loads(draw.choice([SMALL, SMALL, draw.choice(GALLERY).read_text("utf-8")]))
    for _ in range(draw.choice([1, 1, 2, 4])):
        holder, key = draw.choice(list(_places(tables)))
        match draw.choice(["value", "value", "gone", "name", "copy", "key"]):
            case "value":
                holder[key] = deepcopy(draw.choice(VALUES))  # later changes are made in it
            case "gone":
                del holder[key]
            case "name" if isinstance(holder, dict):
                holder[draw.choice(["kind", "name", key + "x", "", "a.b"])] = holder.pop(key)
            case "copy":
                other, name = draw.choice(list(_places(tables)) or [(holder, key)])
                holder[key] = tomllib.loads(tomli_w.dumps({"copy": other[name]}))["copy"]
            case _:
                _set(tables, draw)
        if not tables:
            break
    (folder / "s.toml").write_text(tomli_w.dumps(tables), "utf-8")
    return _read(draw)


def changed_text(draw: random.Random, folder: Path, results: Path) -> Case:
    """A scenario with lines and bytes that are others."""
    data = draw.choice([SMALL.encode(), draw.choice(GALLERY).read_bytes()])
    for _ in range(draw.choice([1, 2, 5])):
        data = _garbled(draw, data)
    if draw.random() < 0.2:
        data = _inserted(draw, data, draw.choice(HOSTILE).encode())
    (folder / "s.toml").write_bytes(data)
    return _read(draw)


def changed_sets(draw: random.Random, folder: Path, results: Path) -> Case:
    """Known keys with odd values, by ``--set``."""
    (folder / "s.toml").write_text(SMALL, "utf-8")
    case = _read(draw)
    for _ in range(draw.choice([1, 1, 2, 3])):
        key, *usual = draw.choice(KEYS)
        key = key.replace("NAME", "car1").replace("SENSOR", "gps")
        value = tomli_w.dumps({"v": draw.choice([*VALUES, *usual, *usual])}).partition("=")[2].strip()
        case += ["--set", f"{key}={value}".replace("\0", "")]
    return case


def changed_results(draw: random.Random, folder: Path, results: Path) -> Case:
    """What a run left, with one or two files that are no longer whole."""
    shutil.copytree(results, folder / "results")
    for path in draw.choices(
        [each for each in sorted((folder / "results").iterdir()) if each.is_file()], k=draw.choice([1, 2])
    ):
        match draw.choice(["garbled", "garbled", "cut", "gone", "empty", "json", "folder"]):
            case "garbled" if path.is_file():
                path.write_bytes(_garbled(draw, path.read_bytes()))
            case "cut" if path.is_file():
                path.write_bytes(path.read_bytes()[: draw.randrange(path.stat().st_size or 1)])
            case "json" if not path.is_dir():
                path.write_text(draw.choice(["[]", "{}", "null", '{"version": 1}', "[" * 500, '{"metrics": []}']), "utf-8")
            case "folder" if path.is_file():
                path.unlink()
                path.mkdir()
            case "empty" if not path.is_dir():
                path.write_bytes(b"")
            case _ if path.is_file():
                path.unlink()
    return list(draw.choice(RESULTS))


def command_line(draw: random.Random, folder: Path, results: Path) -> Case:
    """A command with arguments and options of its own, and odd values for them."""
    (folder / "s.toml").write_text(SMALL, "utf-8")
    shutil.copytree(results, folder / "results")
    name = draw.choice(SAFE)
    command = COMMANDS[name]
    writes = {"--out", "--png", "--mitsuba", *(["--positions"] if name == "radio" else [])}
    case, options = [name], []
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            case += [
                draw.choice(["s.toml", "s.toml", "results", "results/run.mcap", *WORDS])
                for _ in range(draw.choice([0, 1, 1, 1]))
            ]
        elif not set(parameter.opts) & {*DOERS, "--help", *writes}:
            options.append(parameter)
    for option in draw.sample(options, min(len(options), draw.choice([0, 1, 2, 4]))):
        case += [
            option.opts[0],
            *([] if option.is_flag else [draw.choice([*WORDS, "s.toml", "results", "radio.loss.probability=0.5"])]),
        ]
    short = SHORT if name in ("run", "study") else ()
    return [*case, *short, *(("--jobs", "1", "--seeds", "1") if name == "study" else ()), *OUTPUTS.get(name, ())]


def _read(draw: random.Random) -> Case:
    return list(
        draw.choice(
            [
                ("check", "s.toml"),
                ("check", "s.toml"),
                ("run", "s.toml", "--out", "out", *SHORT),
                ("show", "s.toml", "--resolved"),
            ]
        )
    )


def _places(tables: Any) -> list[tuple[Any, Any]]:
    """Each key of each table and each place of each list, with what holds it."""
    entries = tables.items() if isinstance(tables, dict) else enumerate(tables)
    found = [(tables, key) for key, _ in entries]
    return found + [place for holder, key in found if isinstance(holder[key], dict | list) for place in _places(holder[key])]


def _set(tables: dict[str, Any], draw: random.Random) -> None:
    """Give a known key an odd value, or one that it may have."""
    key, *usual = draw.choice(KEYS)
    *path, last = key.replace("NAME", "car1").replace("SENSOR", "gps").split(".")
    for part in path:
        inner = tables.setdefault(part, {})
        tables = inner if isinstance(inner, dict) else {}
    tables[last] = deepcopy(draw.choice([*VALUES, *usual]))


def _inserted(draw: random.Random, data: bytes, line: bytes) -> bytes:
    """A line more, somewhere."""
    lines = data.splitlines(keepends=True)
    lines.insert(draw.randrange(len(lines) + 1), line + b"\n")
    return b"".join(lines)


def _garbled(draw: random.Random, data: bytes) -> bytes:
    """Bytes that are others, a piece that is gone or stands twice, or two lines in each other's place."""
    begin = draw.randrange(len(data) + 1)
    end = min(len(data), begin + draw.choice([1, 4, 40, 400]))
    match draw.choice(["bytes", "gone", "twice", "lines"]):
        case "bytes":
            return data[:begin] + draw.randbytes(end - begin) + data[end:]
        case "gone":
            return data[:begin] + data[end:]
        case "twice":
            return data[:end] + data[begin:]
        case _:
            lines = data.splitlines(keepends=True) or [b""]
            one, other = draw.randrange(len(lines)), draw.randrange(len(lines))
            lines[one], lines[other] = lines[other], lines[one]
            return b"".join(lines)
