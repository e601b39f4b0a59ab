"""Worlds by themselves: found by name, file or scenario, counted and drawn."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.config import binding, builtin_kinds, factory, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array

FILES = {".toml": "file", ".yaml": "map", ".yml": "map", ".geojson": "geojson", ".json": "geojson"}
MESHES = (".obj", ".stl", ".ply", ".glb", ".off")


def world_of(what: str, settings: Mapping[str, Any]) -> tuple[Any, str]:
    """The world that a word names: a kind, ``module:Class``, a file (world, map, GeoJSON, mesh), or a scenario; and its name.

    Args:
        what: the word.
        settings: keys of the world or, for a scenario, of the scenario, and their values.
    """
    path, seed = Path(what), 0
    if what in builtin_kinds.KINDS["world"] or ":" in what:
        table_, source, name = {"kind": what}, Source("--set", Path()), what.rpartition(":")[2]
    elif path.suffix in (*FILES, *MESHES) and path.is_file() and not _is_scenario(path):
        kind = FILES.get(path.suffix, "mesh")
        table_, source, name = {"kind": kind, "path": str(path.resolve())}, Source(what, Path()), path.stem
    elif what in scenarios.names() or path.is_file():
        parsed, source = scenarios.load(what, settings=settings)
        table_, name, seed, settings = dict(parsed.world), parsed.name, parsed.seed, {}
    else:
        known = binding.unknown("world", what, [*builtin_kinds.KINDS["world"], *scenarios.names()])
        raise UsageError(f"{known}; or give a file: a world or scenario (.toml), a map (.yaml), GeoJSON, or a mesh")
    world, _ = factory.world_of({**table_, **settings}, source, seed=seed)
    return world, name


def describe(world: Any, name: str) -> dict[str, Any]:
    """What is in a world."""
    kinds = Counter(type(each).__name__.lower() for each in world.solids)
    materials = Counter(each.material for each in world.solids)
    return {
        "world": name,
        "solids": len(world.solids),
        "kinds": dict(sorted(kinds.items())),
        "materials": dict(sorted(materials.items())),
        "movables": len(world.movables),
        "moving": len(world.moving),
        "targets": len(world.targets),
        "bounds": world.bounds,
    }


def outlines(world: Any) -> list[Array]:
    """What stands in a world seen from above: outlines, (k, 2) m each, of its convex pieces; meshes by their triangles."""
    shapes = world.shapes
    return [*(corners for group in shapes.groups for corners in group.corners), *shapes.triangles[:, :, :2]]


def draw(world: Any, target: Path) -> None:
    """Draw a world, from above and in perspective, into a PNG file."""
    if target.suffix.lower() != ".png":
        raise UsageError(f"--png {target}: the name must end in .png")
    pictures = registry.piece("world pictures")
    png: bytes = pictures.png(np.hstack(pictures.draw_world(world)))
    try:
        target.write_bytes(png)
    except OSError as error:
        raise UsageError(f"--png {target}: cannot be written: {error.strerror}") from error


def _is_scenario(path: Path) -> bool:
    return path.suffix == ".toml" and "vehicle" in scenarios.table_of(path)
