"""Worlds without a run: found by name, file or scenario, described and drawn."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError, place_of, words_of
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.files import write_whole

if TYPE_CHECKING:
    from vcmvsp.physics.world.world import World as World  # noqa: PLC0414  for packages above, which must not import physics

FILES = {".toml": "file", ".yaml": "map", ".yml": "map", ".geojson": "geojson", ".json": "geojson"}
MESHES = (".obj", ".stl", ".ply", ".glb", ".off")


def world_of(what: str, settings: Mapping[str, Any]) -> "tuple[World, str]":
    """The world of a kind, ``module:Class``, file (world, map, GeoJSON, mesh) or scenario, and its name.

    Args:
        settings: changed keys of the world, or of the scenario if ``what`` is one.
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
        problem = binding.unknown("world", what, [*builtin_kinds.KINDS["world"], *scenarios.names()])
        raise UsageError(f"{problem}; or name a file: a world or scenario (.toml), a map (.yaml), GeoJSON, or a mesh")
    world, _ = build({**table_, **settings}, source, seed=seed)
    return world, name


def build(
    table: Mapping[str, Any],
    source: Source,
    *,
    seed: int = 0,
    portable: registry.Portable = str,
    keep: registry.Keep = registry.name_of,
) -> "tuple[World, dict[str, Any]]":
    """The world of a table ``[world]``, and the complete table.

    Args:
        source, portable, keep: as for `cosim.config.registry.build`.
        seed: of the run; used by a world whose own ``seed`` is None by default and not given.

    Raises:
        ScenarioError: it cannot be built; names its place in the scenario.
    """
    from vcmvsp.physics.world.world import World

    content = {"kind": "empty", **table}
    maker, resolved = registry.build(
        "world", content, key="world", source=source, portable=portable, absent={"seed": seed}, keep=keep
    )
    try:
        world = maker.build()
    except ScenarioError as error:
        if error.source:
            raise  # the error is in a file that the scenario names
        raise source.error(error.problem, binding.join("world", error.key)) from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a user class may raise anything
        problem = f"{type(maker).__name__}.build raised {words_of(error)}{place_of(error)}"
        raise source.error(problem, "world") from error
    if not isinstance(world, World):
        problem = f"{type(maker).__name__}.build must return a World, not {binding.show(world)}"
        raise source.error(problem, "world")
    return world, resolved


def describe(world: "World", name: str) -> dict[str, Any]:
    """Counts and extents of a world, for `vcmvsp world`."""
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


def outlines(world: "World") -> list[Array]:
    """Outlines of a world's solids from above, (k, 2) m each: convex pieces, triangles of meshes."""
    shapes = world.shapes
    return [*(corners for group in shapes.groups for corners in group.corners), *shapes.triangles[:, :, :2]]


def draw(world: "World", target: Path) -> None:
    """Write a PNG file of a world, from above and in perspective."""
    if target.suffix.lower() != ".png":
        raise UsageError(f"--png {target}: the name must end in .png")
    from vcmvsp.physics.render import world_picture

    png = world_picture.png(np.hstack(world_picture.draw_world(world)))
    try:
        write_whole(target, png)
    except OSError as error:
        raise UsageError(f"--png {target}: cannot be written: {error.strerror}") from error


def write_mitsuba(world: "World", folder: Path, *, slab_m: float = 0.5, ground: str = "concrete") -> int:
    """Write a scene of Mitsuba that Sionna RT loads; returns the number of its meshes.

    Args:
        world: with materials of ITU-R P.2040-3.
        folder: for the files, `scene.xml` and meshes.
        slab_m, ground: as for ``path_loss = { kind = "rays" }``.
    """
    from vcmvsp.netsim.propagation.rays.coefficients import MATERIALS
    from vcmvsp.physics.raycast import mitsuba_scene

    for solid in world.solids:
        if solid.material not in MATERIALS:
            raise UsageError(f"--mitsuba: {solid.words} is of {solid.material!r}, not one of {', '.join(MATERIALS)}")
    content = mitsuba_scene.files(world.solids, slab_m, ground)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in content.items():
            write_whole(folder / name, text.encode("utf-8"))
    except OSError as error:
        raise UsageError(f"--mitsuba {folder}: cannot be written: {error.strerror}") from error
    return len(content) - 1


def ground_of(what: str) -> dict[str, Any]:
    """The keys ``slab_m`` and ``ground`` of the rays of a scenario, as far as it has them."""
    if what not in scenarios.names() and not (Path(what).is_file() and _is_scenario(Path(what))):
        return {}
    rays = scenarios.load(what)[0].first_radio.get("path_loss")
    table_ = rays if isinstance(rays, Mapping) and rays.get("kind") == "rays" else {}
    return {name: table_[name] for name in ("slab_m", "ground") if name in table_}


def _is_scenario(path: Path) -> bool:
    return path.suffix == ".toml" and "vehicle" in scenarios.table_of(path)
