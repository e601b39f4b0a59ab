"""Compiles ``wifi.cc`` against the ns-3 wheel, runs it, and stores its results.

The wheel (``pip install --no-deps ns3==3.44.post0``, in an environment of its own) carries headers and libraries. The variable
``NS3_PREFIX`` names its folder ``.../site-packages/ns3``; without it the one of ``make .ns3/.ready`` is taken, or the running
interpreter's. ``NS3_RESULTS`` names the folder in which the program and the results are stored.
"""

import hashlib
import importlib.util
import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SOURCE = Path(__file__).with_name("wifi.cc")
RESULTS = "1"  # increased when the program computes something else: stored results are then ignored
LIBRARIES = ("wifi", "core", "network", "propagation", "spectrum", "mobility", "antenna", "stats", "energy")
HOME = Path(".ns3")  # see the Makefile
WHEEL = "make .ns3/.ready, or NS3_PREFIX=.../site-packages/ns3 of ns3==3.44.post0"

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class MissingError(SystemExit):
    """ns-3 is not installed."""


class Frames(NamedTuple):
    """Sent frames, f among n nodes, in the order of sending; -1: never."""

    sender: Ints  # (f,)
    to: Ints  # (f,) -1: all
    sent_ns: Ints  # (f,) handed to the device
    start_ns: Ints  # (f,) begins on the air, first attempt
    attempts: Ints  # (f,)
    delay_ns: NDArray[np.int32]  # (f, n) from the offer to the delivery at a receiver


class Result(NamedTuple):
    """One run: the totals that the program prints, and every frame."""

    totals: dict[str, Any]
    frames: Frames


def run(positions: Floats, options: Mapping[str, str | float]) -> Result:
    """Run ``wifi.cc`` at ``positions`` (n, 3) m, or load the result of an equal run.

    Args:
        positions: of the nodes.
        options: the program's other ones, without dashes: ``{"hz": 10, "seed": 1}``.
    """
    lines = "".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in positions.tolist())
    words = [f"--{name}={value}" for name, value in sorted(options.items())]
    stem = folder() / hashlib.sha256("\n".join([RESULTS, lines, *words]).encode()).hexdigest()[:24]
    result = stem.with_suffix(".npz")
    if not result.exists():
        rows, places, part = (stem.with_suffix(f".{os.getpid()}.{kind}") for kind in ("bin", "csv", "npz"))
        places.write_text(lines)
        command = [str(program()), f"--positions={places}", f"--out={rows}", *words]
        totals = subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout
        np.savez_compressed(part, totals=np.array(totals), **read(rows, len(positions))._asdict())
        part.replace(result)
        rows.unlink()
        places.unlink()
    with np.load(result) as stored:
        return Result(json.loads(str(stored["totals"])), Frames(**{name: stored[name] for name in Frames._fields}))


def read(path: Path, nodes: int) -> Frames:
    """Frames that the program wrote to ``--out``."""
    rows = np.fromfile(path, np.int64).reshape(-1, 7 + nodes)
    received, sent = rows[:, 7:], rows[:, 3]
    delay = np.where(received < 0, -1, received - sent[:, None]).astype(np.int32)
    return Frames(rows[:, 0], rows[:, 2], sent, rows[:, 4], rows[:, 6], delay)


def folder() -> Path:
    """Folder of the program and its results."""
    path = Path(os.environ.get("NS3_RESULTS", Path(tempfile.gettempdir()) / "ns3-results"))
    path.mkdir(parents=True, exist_ok=True)
    return path


def program() -> Path:
    """The compiled program; compiled again when its source has changed."""
    sources = SOURCE.read_bytes() + SOURCE.with_name("wifi_frames.h").read_bytes()
    target = folder() / f"wifi-{hashlib.sha256(sources).hexdigest()[:12]}"
    if not target.exists():
        ns3 = _prefix()
        libraries = [f"-lns3.44-{name}" for name in LIBRARIES]
        command = ["g++", "-O2", "-std=c++20", f"-I{ns3}/include", str(SOURCE), "-o", str(target), f"-L{ns3}/lib64", *libraries]
        subprocess.run([*command, f"-Wl,-rpath,{ns3}/lib64", "-Wl,--allow-shlib-undefined"], check=True)
    return target


def _prefix() -> Path:
    named = os.environ.get("NS3_PREFIX")
    found = importlib.util.find_spec("ns3")
    own = map(Path, found.submodule_search_locations or ()) if found else ()
    for place in [Path(named)] if named else [*HOME.resolve().glob("lib/python*/site-packages/ns3"), *own]:
        if (place / "include" / "ns3" / "wifi-module.h").exists():
            return place
    raise MissingError(f"no ns-3: {WHEEL}")
