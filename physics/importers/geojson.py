"""Buildings from GeoJSON: footprints with heights, from OpenStreetMap, city registers and GIS programs."""

import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.tangent_plane import E2, A
from vcmvsp.cosim.types import Array, FileName, NonNegative, Positive
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.polygons import problem_of
from vcmvsp.physics.importers.files import require_file, text_of
from vcmvsp.physics.world.solids import Color, Point2, Prism
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings

STOREY_M = 3.0  # of a building with levels and no height


@dataclass(frozen=True, kw_only=True)
class GeoJson(Surroundings):
    """Buildings from a GeoJSON file (kind ``geojson``): polygons, also with courtyards; points and lines are ignored.

    The property ``height`` gives the height (m), else ``building:levels`` times 3 m, else ``default_height``; the building
    begins at its ``min_height``. Longitudes and latitudes become metres east and north of the origin.
    """

    path: FileName  # of the file
    # longitude, latitude, degrees (metric: x, y, m) of the world's origin; None: the middle of all
    origin: Point2 | None = None
    metric: bool = False  # whether coordinates are metres already
    default_height: Positive = 6.0  # height of buildings without one, m
    skip_invalid: bool = False  # true: footprints that cross themselves are left out; false: they are an error
    material: str = "concrete"  # of all buildings
    color: Color | None = None  # of all buildings; None: that of the material

    def __post_init__(self) -> None:
        super().__post_init__()
        require_file(self.path)
        if self.origin is not None and not self.metric and not (abs(self.origin[0]) <= 180.0 and abs(self.origin[1]) < 90.0):
            problem = f"must be longitude and latitude in degrees, not {self.origin}; for metres set metric = true"
            raise ScenarioError(problem, key="origin")

    def build(self) -> World:
        """Build the world from the file.

        Raises:
            ScenarioError: with the file, and the building that is wrong.
        """
        path = Path(self.path)
        try:
            content = read_json(text_of(path))
        except ValueError as error:
            raise ScenarioError(f"is not JSON: {error}", source=str(path)) from error
        footprints = list(_footprints(content, path))
        if not footprints:
            raise ScenarioError("contains no Polygon or MultiPolygon: export buildings as areas", source=str(path))
        places = np.concatenate([ring for _, _, rings in footprints for ring in rings])
        if not self.metric and (np.abs(places) > (180.0, 90.0)).any():
            problem = "has coordinates beyond 180 and 90 degrees: if they are metres, set metric = true"
            raise ScenarioError(problem, source=str(path))
        middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
        origin = (float(middle[0]), float(middle[1])) if self.origin is None else self.origin
        scale = np.ones(2) if self.metric else metres_per_degree(origin[1])
        solids = []
        for words, properties, rings in footprints:
            outline, *holes = (tuple(map(tuple, ((ring - origin) * scale).tolist())) for ring in rings)
            if problem := problem_of(outline, holes):
                if self.skip_invalid:
                    continue
                problem = f"the footprint {problem}: repair it, or set skip_invalid = true"
                raise ScenarioError(problem, key=words, source=str(path))
            bottom, top = self._extent(properties, words, path)
            look: dict[str, Any] = {"material": self.material, "color": self.color}
            solids.append(Prism(outline=outline, holes=tuple(holes), bottom=bottom, height=top - bottom, **look))
        return self.complete(path.stem, solids=solids)

    def _extent(self, properties: Mapping[str, Any], words: str, path: Path) -> tuple[NonNegative, float]:
        top, levels = metres(properties.get("height")), metres(properties.get("building:levels"))
        if top is None:
            top = self.default_height if levels is None or levels <= 0.0 else STOREY_M * levels
        bottom = metres(properties.get("min_height")) or 0.0
        if not 0.0 <= bottom < top:
            problem = f"a building from {bottom:g} m to {top:g} m has no height: correct its height or min_height"
            raise ScenarioError(problem, key=words, source=str(path))
        return bottom, top


def metres(value: Any) -> float | None:
    """A property as a length: a number, or text such as "12.5", "12 m"; None: it is none."""
    if isinstance(value, str):
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(?:m|metres?|meters?)?\s*", value)
        value = float(match[1]) if match else None
    good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return float(value) if good else None


def metres_per_degree(latitude: float) -> Array:
    """Of longitude and of latitude, (2,): radii of curvature of the WGS 84 ellipsoid at the origin's latitude.

    An equirectangular projection: a place x m east and y m north of the origin is off by about ``x y tan(latitude) / R`` to the
    east, and half of ``x^2 tan(latitude) / R`` to the north, R = 6371 km. At a latitude of 50 degrees that is less than 0.2 m
    within a square kilometre around the origin, and grows with the square of the distance.
    """
    phi = math.radians(latitude)
    w2 = 1.0 - E2 * math.sin(phi) ** 2
    prime_vertical, meridian = A / math.sqrt(w2), A * (1.0 - E2) / w2**1.5
    return np.radians([prime_vertical * math.cos(phi), meridian])


def _footprints(content: Any, path: Path) -> Iterator[tuple[str, Mapping[str, Any], list[Array]]]:
    """Each polygon: name for messages, properties, and rings (k, 2), outline first, without the closing point."""
    features: Any = content["features"] if isinstance(content, dict) and "features" in content else [content]
    if not isinstance(features, list) or not all(isinstance(each, dict) for each in features):
        raise ScenarioError("is not GeoJSON: it needs a FeatureCollection, a Feature or a geometry", source=str(path))
    for number, feature in enumerate(features):
        geometry = feature.get("geometry") if "geometry" in feature else feature
        properties = feature.get("properties") or {}
        if not isinstance(properties, dict):
            problem = f"its properties must be an object of names and values, not {properties!r}"
            raise ScenarioError(problem, key=f"features.{number}", source=str(path))
        name = properties.get("name") or feature.get("id")
        words = f"features.{number}" + (f" ({name})" if name else "")
        if isinstance(geometry, dict) and geometry.get("type") in ("Polygon", "MultiPolygon"):
            coordinates = geometry.get("coordinates")
            polygons: Any = [coordinates] if geometry["type"] == "Polygon" else coordinates
            try:
                for polygon in polygons:
                    if polygon != []:  # empty coordinates are valid (RFC 7946, 3.1)
                        yield words, properties, [_ring(ring) for ring in polygon]
            except (TypeError, ValueError, IndexError, OverflowError) as error:
                problem = f"its coordinates must be rings of [x, y]: {error}"
                raise ScenarioError(problem, key=words, source=str(path)) from error
        elif isinstance(geometry, dict) and geometry.get("type") == "GeometryCollection":
            raise ScenarioError("GeometryCollection is not supported: split it into features", key=words, source=str(path))


def _ring(coordinates: Any) -> Array:
    """A ring without heights, repeated points and the closing point; it has at least one point."""
    points = np.array([(float(x), float(y)) for x, y, *_ in coordinates])
    if not len(points) or not np.isfinite(points).all():
        raise ValueError("a ring is empty or not finite")
    ring: Array = points[(points != np.roll(points, -1, axis=0)).any(axis=1)]
    return ring if len(ring) else points[:1]
