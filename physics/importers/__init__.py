"""Worlds read from files; like those of `physics.worlds`, each has ``build() -> World``."""

from physics.importers.footprints import GeoJson
from physics.importers.mesh import MeshFile
from physics.importers.occupancy import Map
from physics.importers.toml_file import File

__all__ = ["File", "GeoJson", "Map", "MeshFile"]
