"""Worlds from TOML files and triangle meshes; file access of all importers."""

import importlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FileName, NonNegative, Positive, Vec3
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml
from vcmvsp.physics.world.solids import Color, Mesh
from vcmvsp.physics.world.world import Light, Wind, World
from vcmvsp.physics.worlds.surroundings import Empty, Surroundings


def require_file(path: str) -> None:
    """Refuse a missing file, at the key ``path``."""
    if not Path(path).is_file():
        raise ScenarioError(f"there is no file {path}", key="path")


def text_of(path: Path) -> str:
    """The text of a file.

    Raises:
        ScenarioError: it cannot be read, or is no UTF-8.
    """
    try:
        return limits.read_text(path)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"cannot be read as text: {error}", source=str(path)) from error


def library(name: str, path: str, install: str) -> Any:
    """Import an optional library that the file ``path`` needs; ``install``: arguments of ``pip install``.

    Raises:
        ScenarioError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ScenarioError(f"reading it needs the package {name}: pip install {install}", source=path) from error


@dataclass(frozen=True, kw_only=True)
class File:
    """A world from a TOML file (kind ``file``): ``[[boxes]]``, ``[[cylinders]]``, ``[ground]`` ... as in kind ``boxes``.

    Pictures are found beside the file.
    """

    path: FileName  # of the TOML file
    floor_friction: NonNegative | None = None  # multiplies the friction of what rolls or slides; None: the file's
    wind: Wind | None = None  # air that moves; None: the file's
    light: Light | None = None  # where the sun is; None: the file's

    def __post_init__(self) -> None:
        require_file(self.path)

    def files(self) -> tuple[Path, ...]:
        """Picture files that the world names."""
        listed, _ = self._read()
        painted: list[Any] = [listed.ground, *listed.ground.marks, *listed.targets]
        return tuple(Path(each.picture) for each in painted if each.picture)

    def _read(self) -> tuple[Empty, Source]:
        path = Path(self.path)
        text = text_of(path)
        try:
            content = read_toml(text)
        except ValueError as error:
            raise ScenarioError(f"is not TOML: {error}", source=str(path)) from error
        source = Source(str(path), path.parent, text)
        listed = binding.call(Empty, content, origin=source)
        return beside(path.parent, listed), source

    def build(self) -> World:
        """Build the world from the file.

        Raises:
            ScenarioError: with the file, the line and the key that is wrong.
        """
        listed, source = self._read()
        try:
            world = listed.build()
        except ScenarioError as error:
            raise source.error(error.problem, error.key) from error
        given: dict[str, Any] = {key: getattr(self, key) for key in ("floor_friction", "wind", "light")}
        changes = {key: value for key, value in given.items() if value is not None}
        return replace(world, name=Path(self.path).stem, **changes)


def beside(folder: Path, listed: Empty) -> Empty:
    """The world with picture files in a folder."""

    def located(each: Any) -> Any:
        """A ground, mark or target with the path of its picture; a run keeps it by its file name, beside the world's file."""
        if not each.picture:
            return each
        places = [registry.located(name, folder) for name in (each.picture, Path(each.picture).name)]
        path = next((path for path in places if path.is_file()), places[0])
        return msgspec.structs.replace(each, picture=str(path))

    ground = msgspec.structs.replace(located(listed.ground), marks=tuple(map(located, listed.ground.marks)))
    return replace(listed, ground=ground, targets=tuple(map(located, listed.targets)))


@dataclass(frozen=True, kw_only=True)
class MeshFile(Surroundings):
    """One mesh (kind ``mesh``): OBJ, STL, PLY, GLB and what else trimesh reads (``pip install trimesh``)."""

    path: FileName  # of the file
    scale: Positive = 1.0  # multiplies its coordinates, e.g. 0.001 for millimetres
    up: Literal["z", "y"] = "z"  # which of its axes points up: CAD has z, computer graphics y
    position: Vec3 = (0.0, 0.0, 0.0)  # of its origin, m, world
    yaw_rad: float = 0.0  # turned by this about the vertical through its origin
    material: str = "concrete"  # of all of it
    color: Color | None = None  # of all of it; None: that of the material

    def __post_init__(self) -> None:
        super().__post_init__()
        require_file(self.path)

    def build(self) -> World:
        """Build the world from the mesh.

        Raises:
            ScenarioError: with the file, and the triangle that is wrong.
        """
        trimesh = library("trimesh", self.path, "trimesh")
        try:
            limits.check_archive(Path(self.path))
            corners = np.array(trimesh.load_mesh(self.path, process=False).triangles, np.float64)
        except Exception as error:  # any error of a reader of some format
            problem = f"trimesh cannot read it: {type(error).__name__}: {error}; "
            problem += "OBJ, STL and PLY need no further packages"
            raise ScenarioError(problem, source=self.path) from error
        if not len(corners):
            raise ScenarioError("contains no triangles: export a surface, not points or lines", source=self.path)
        bad = np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2)))
        if len(bad):
            problem = f"triangle {bad[0]} has a non-finite corner ({len(bad)} of {len(corners)} triangles): repair the mesh"
            raise ScenarioError(problem, source=self.path)
        if self.up == "y":
            corners = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1]], axis=-1)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned = self.scale * corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        mesh = Mesh(triangles=turned + np.array(self.position), material=self.material, color=self.color)
        return self.complete(Path(self.path).stem, solids=[mesh])
