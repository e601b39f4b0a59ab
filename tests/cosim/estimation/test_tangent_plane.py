"""Tangent plane: known points, the curvature of the ellipsoid, and the inverse."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.estimation.tangent_plane import E2, A, B, TangentPlane, from_earth, to_earth

latitudes, longitudes = st.floats(-90.0, 90.0), st.floats(-180.0, 180.0)


def test_semi_minor_axis_is_that_of_the_standard() -> None:
    assert pytest.approx(6356752.3142, abs=1e-4) == B  # NIMA TR8350.2, table 3.3


@pytest.mark.parametrize(
    ("place", "earth"),
    [
        ((0.0, 0.0, 0.0), (A, 0.0, 0.0)),
        ((0.0, 90.0, 100.0), (0.0, A + 100.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, B)),
        ((-90.0, 0.0, 50.0), (0.0, 0.0, -B - 50.0)),
    ],
)
def test_axes_of_the_earth(place: tuple[float, float, float], earth: tuple[float, float, float]) -> None:
    assert to_earth(*place) == pytest.approx(earth, abs=1e-8)
    latitude, _, height = from_earth(*earth)
    assert (latitude, height) == pytest.approx((place[0], place[2]), abs=1e-8)


def test_matterhorn_seen_from_zermatt() -> None:
    # Example of MATLAB's geodetic2enu: WGS 84, five digits
    east, north, up = TangentPlane(46.017, 7.750, 1673.0).enu(45.976, 7.658, 4531.0)
    assert (east, north, up) == pytest.approx((-7134.8, -4556.3, 2852.4), abs=0.05)


@given(st.floats(-89.0, 89.0), longitudes, st.floats(-100.0, 9000.0))
def test_small_steps_follow_the_radii_of_curvature(latitude: float, longitude: float, height: float) -> None:
    # Meridian radius M and prime vertical radius N of the ellipsoid, from any book of geodesy
    s = math.sin(math.radians(latitude))
    n = A / math.sqrt(1 - E2 * s * s)
    m = n * (1 - E2) / (1 - E2 * s * s)
    plane, step = TangentPlane(latitude, longitude, height), 1e-4  # degrees, about 11 m
    arc = math.radians(step)
    assert plane.enu(latitude + step, longitude, height) == pytest.approx((0.0, (m + height) * arc, 0.0), abs=1e-3)
    across = (n + height) * math.cos(math.radians(latitude)) * arc
    assert plane.enu(latitude, longitude + step, height) == pytest.approx((across, 0.0, 0.0), abs=1e-3)
    assert plane.enu(latitude, longitude, height + 1.0) == pytest.approx((0.0, 0.0, 1.0), abs=1e-7)


@given(latitudes, longitudes, st.floats(-500.0, 9000.0), *[st.floats(-10e3, 10e3)] * 2, st.floats(-1e3, 1e3))
def test_there_and_back_within_a_micrometre(lat: float, lon: float, h: float, east: float, north: float, up: float) -> None:
    plane = TangentPlane(lat, lon, h)
    assert plane.enu(*plane.geodetic(east, north, up)) == pytest.approx((east, north, up), abs=1e-6)


@given(latitudes, longitudes, st.floats(-10e3, 1e6))
def test_earth_centred_there_and_back(lat: float, lon: float, h: float) -> None:
    back = from_earth(*to_earth(lat, lon, h))
    assert (back[0], back[2]) == pytest.approx((lat, h), abs=1e-6)
    assert to_earth(*back) == pytest.approx(to_earth(lat, lon, h), abs=1e-6)


def test_a_latitude_beyond_the_pole_is_refused() -> None:
    with pytest.raises(ValueError, match="latitude"):
        TangentPlane(91.0, 0.0)
