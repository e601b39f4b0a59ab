"""Triangle meshes from CAD, scans and other simulators, read by `trimesh`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FileName, Positive, Vec3
from vcmvsp.cosim.util import limits
from vcmvsp.physics.importers.file_access import library, require_file
from vcmvsp.physics.world.solids import Color, Mesh
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings


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
        """The world itself.

        Raises:
            ScenarioError: with the file, and the triangle that is wrong.
        """
        mesh = self.mesh()
        return self.complete(Path(self.path).stem, solids=[mesh])

    def mesh(self) -> Mesh:
        """The mesh in the world.

        Raises:
            ScenarioError: with the file, and the problem.
        """
        trimesh = library("trimesh", self.path, "trimesh")
        try:
            limits.check_archive(Path(self.path))
            corners = np.array(trimesh.load_mesh(self.path, process=False).triangles, np.float64)
        except Exception as error:  # whatever a reader of some format trips over
            problem = (
                f"trimesh cannot read it: {type(error).__name__}: {error}; OBJ, STL and PLY are read without further packages"
            )
            raise ScenarioError(problem, source=self.path) from error
        if not len(corners):
            raise ScenarioError("holds no triangles: export a surface, not points or lines", source=self.path)
        bad = np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2)))
        if len(bad):
            problem = f"triangle {bad[0]} has a corner that is not finite ({len(bad)} of {len(corners)} have): repair the mesh"
            raise ScenarioError(problem, source=self.path)
        if self.up == "y":
            corners = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1]], axis=-1)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned = self.scale * corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return Mesh(triangles=turned + np.array(self.position), material=self.material, color=self.color)
