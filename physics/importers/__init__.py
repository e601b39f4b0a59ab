"""Worlds read from files; like those of `physics.worlds`, each has ``build() -> World``. Nothing here makes up a world."""

from vcmvsp.physics.importers.geojson import GeoJson
from vcmvsp.physics.importers.mesh_file import MeshFile
from vcmvsp.physics.importers.occupancy_grid import Map
from vcmvsp.physics.importers.toml_file import File

__all__ = ["File", "GeoJson", "Map", "MeshFile"]
