"""Buildings from footprints: heights, courtyards, degrees to metres."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import area_m2
from vcmvsp.physics.importers.geojson import GeoJson, metres, metres_per_degree
from vcmvsp.physics.world.solids import Prism
from vcmvsp.physics.world.world import World

SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]]
BOW = [[0, 0], [2, 2], [3, 0], [0, 2], [0, 0]]
COURT = [[4, 4], [4, 6], [6, 6], [6, 4], [4, 4]]


def feature(coordinates: Any, kind: str = "Polygon", **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def write(folder: Path, *features: Any) -> str:
    path = folder / "town.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(path)


def prisms(world: World) -> list[Prism]:
    assert all(isinstance(solid, Prism) for solid in world.solids)
    return [solid for solid in world.solids if isinstance(solid, Prism)]


def test_buildings_with_courtyards_and_heights(tmp_path: Path) -> None:
    shifted = [[[x + 20, y] for x, y in ring] for ring in (SQUARE, COURT)]
    path = write(
        tmp_path,
        feature([SQUARE, COURT], height="12.5 m"),
        feature([[SQUARE], shifted], "MultiPolygon", **{"building:levels": "4"}),
        feature([SQUARE], height="tall", min_height=2),
        feature([1, 2], "Point", height=3),
    )
    found = prisms(GeoJson(path=path, metric=True, origin=(0.0, 0.0), default_height=7.0).build())
    assert [(each.bottom, each.bottom + each.height) for each in found] == [(0.0, 12.5), (0.0, 12.0), (0.0, 12.0), (2.0, 7.0)]
    assert [len(each.holes) for each in found] == [1, 0, 1, 0]
    areas = [sum(area_m2(piece.corners) for piece in each.uprights()) for each in found]
    assert areas == pytest.approx([96.0, 100.0, 96.0, 100.0])


def test_the_origin_is_the_middle_unless_it_is_given(tmp_path: Path) -> None:
    path = write(tmp_path, feature([SQUARE]))
    assert prisms(GeoJson(path=path, metric=True).build())[0].outline[0] == (-5.0, -5.0)
    assert prisms(GeoJson(path=path, metric=True, origin=(1.0, 2.0)).build())[0].outline[0] == (-1.0, -2.0)


def enu(longitude: float, latitude: float, origin: tuple[float, float]) -> Array:
    """East, north, up, m, of a place on the WGS 84 ellipsoid, from geocentric coordinates."""

    def geocentric(lon: float, lat: float) -> Array:
        a, f = 6_378_137.0, 1.0 / 298.257223563
        e2 = f * (2.0 - f)
        n = a / math.sqrt(1.0 - e2 * math.sin(lat) ** 2)
        return n * np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), (1.0 - e2) * math.sin(lat)])

    lon, lat, lon0, lat0 = map(math.radians, (longitude, latitude, *origin))
    d = geocentric(lon, lat) - geocentric(lon0, lat0)
    east = [-math.sin(lon0), math.cos(lon0), 0.0]
    north = [-math.sin(lat0) * math.cos(lon0), -math.sin(lat0) * math.sin(lon0), math.cos(lat0)]
    return np.array([east, north]) @ d


@pytest.mark.parametrize("latitude", [0.0, 31.2, 50.0, -45.0])
def test_degrees_become_metres_within_the_stated_error(latitude: float) -> None:
    scale, tangent = metres_per_degree(latitude), abs(math.tan(math.radians(latitude)))
    for east, north in ((500.0, 500.0), (-500.0, 500.0), (500.0, 0.0), (0.0, -500.0), (2000.0, 2000.0)):
        longitude, up = np.array([east, north]) / scale
        truth = enu(121.0 + longitude, latitude + up, (121.0, latitude))
        stated = np.array([abs(east * north), 0.5 * east**2]) * tangent / 6.371e6
        assert (np.abs([east, north] - truth) <= 1.02 * stated + 1e-6 * abs(east) ** 1.5 + 2e-3).all()
        if max(abs(east), abs(north)) <= 500.0 and abs(latitude) <= 50.0:
            assert np.hypot(*([east, north] - truth)) < 0.2


def test_a_degree_at_the_equator_and_at_45_north() -> None:
    assert metres_per_degree(0.0) == pytest.approx([111_319.5, 110_574.3], abs=0.1)  # NIMA TR8350.2
    assert metres_per_degree(45.0) == pytest.approx([78_846.8, 111_131.8], abs=0.1)


@pytest.mark.parametrize(
    ("value", "length"),
    [
        (12, 12.0),
        ("12", 12.0),
        ("12.5 m", 12.5),
        (" 3metres", 3.0),
        ("tall", None),
        (None, None),
        (True, None),
        ("40'", None),
        (math.nan, None),
        (10**400, None),
        ("9" * 400, None),
    ],
)
def test_usual_notations_of_heights(value: Any, length: float | None) -> None:
    assert metres(value) == length


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ([feature([BOW], name="Town hall")], ("features.0 (Town hall)", "crosses", "skip_invalid")),
        ([feature([SQUARE]), feature([SQUARE], height=-1)], ("features.1", "from 0 m to -1 m")),
        ([feature([SQUARE], height=2, min_height=3)], ("features.0", "from 3 m to 2 m")),
        ([feature([SQUARE, [[20, 20], [21, 20], [21, 21]]])], ("features.0", "hole (number 0) outside its outline")),
        ([feature([[1, 2], [3, 4]], "LineString")], ("no Polygon",)),
        ([feature([[["a", 2]]])], ("features.0", "must be rings")),
        ([feature([[]])], ("features.0", "must be rings")),
        ([5], ("is not GeoJSON",)),
        ([feature([[[10**400, 0], [1, 1], [0, 1]]])], ("features.0", "must be rings")),
        ([feature([[[3, 3]] * 5])], ("features.0", "three corners", "skip_invalid")),
        ([{**feature([SQUARE]), "properties": ["height"]}], ("features.0", "properties must be an object")),
        ([feature([])], ("no Polygon",)),
        ([feature([[]], "MultiPolygon")], ("no Polygon",)),
    ],
)  # fmt: skip
def test_errors_of_footprints_are_named(tmp_path: Path, features: list[Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ScenarioError) as caught:
        GeoJson(path=write(tmp_path, *features), metric=True).build()
    assert all(word in str(caught.value) for word in (*words, "town.geojson")), str(caught.value)


def test_invalid_footprints_may_be_omitted_and_metres_warn(tmp_path: Path) -> None:
    path = write(tmp_path, feature([BOW]), feature([SQUARE]))
    assert len(GeoJson(path=path, metric=True, skip_invalid=True).build().solids) == 1
    point = write(tmp_path, feature([[[3, 3]] * 5]), feature([SQUARE]), feature([]))
    assert len(GeoJson(path=point, metric=True, skip_invalid=True).build().solids) == 1
    far = write(tmp_path, feature([[[x + 500, y] for x, y in SQUARE]]))
    with pytest.raises(ScenarioError, match="metric = true"):
        GeoJson(path=far).build()
    (tmp_path / "town.geojson").write_text("{")
    with pytest.raises(ScenarioError, match=r"town\.geojson: is not JSON"):
        GeoJson(path=far).build()


@pytest.mark.parametrize("origin", [(11.5, 120.0), (11.5, 90.0), (-181.0, 48.0), (math.nan, 48.0)])
def test_an_impossible_origin_is_refused_unless_all_is_metric(tmp_path: Path, origin: tuple[float, float]) -> None:
    path = write(tmp_path, feature([SQUARE]))
    with pytest.raises(ScenarioError, match="longitude and latitude in degrees") as caught:
        GeoJson(path=path, origin=origin)
    assert caught.value.key == "origin"
    GeoJson(path=path, origin=(180.0, -89.9))
    GeoJson(path=path, origin=origin, metric=True)
