"""Diffraction: the exact field round a metal wedge, continuity for every material, both directions."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import jv

from tests.support.netsim.ray_worlds import field, rays_among, trace_paths
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.rays.coefficients import MATERIALS
from vcmvsp.netsim.propagation.rays.loss import Rays
from vcmvsp.physics.world.solids import AnySolid, Box, Prism

WAVE_M = SPEED_OF_LIGHT / 2.4e9
FAR_M = 1e6
CORNER = Box(center=(500.0, -500.0, 0.0), size=(1000.0, 1000.0, 1e5), material="metal")
"""Its edge is the z axis; the first face lies along +x, the second along -y."""


def exact(distance_m: float, angle: Floats, source: float) -> NDArray[np.complex128]:
    """Field of a plane wave of unit size, parallel to the edge, round a metal wedge of 90 degrees.

    J. J. Bowman, T. B. A. Senior, P. L. E. Uslenghi, Electromagnetic and acoustic scattering by simple shapes, 1969, 6.2: with
    ``n = 3 / 2``, ``4 / n sum_m exp(j pi m / 2 n) J_(m / n)(k r) sin(m angle / n) sin(m source / n)``.
    """
    n, size = 1.5, 2.0 * math.pi / WAVE_M * distance_m
    order = np.arange(1, 60 + int(3 * size)) / n
    terms = np.exp(0.5j * math.pi * order) * jv(order, size) * np.sin(order * source)
    return np.asarray(4.0 / n * (terms * np.sin(order * angle[:, None])).sum(axis=1))


@pytest.mark.parametrize("source_deg", [20, 60, 100, 135, 200])
@pytest.mark.parametrize("distance_m", [0.5, 2.0])
def test_field_round_a_metal_edge_is_the_exact_series(source_deg: int, distance_m: float) -> None:
    source, angle = math.radians(source_deg), np.radians(np.arange(2.3, 268.0, 6.2))
    places = distance_m * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    found = field(rays_among(CORNER), [FAR_M * math.cos(source), FAR_M * math.sin(source), 0.0], places)
    expected = np.abs(exact(distance_m, angle, source)) * WAVE_M / (4.0 * math.pi * FAR_M)
    assert np.abs(20.0 * np.log10(np.abs(found) / expected)).max() < 0.15


BUILDINGS: dict[str, tuple[AnySolid, ...]] = {}
for name in MATERIALS:
    turned = Box(center=(0.0, 0.0, 10.0), size=(30.0, 30.0, 20.0), yaw_rad=0.4, material=name)
    oblique = Prism(outline=((0.0, 0.0), (40.0, -10.0), (30.0, 30.0), (-5.0, 25.0)), height=20.0, material=name)
    sheet = Box(center=(0.0, 0.0, 5.0), size=(20.0, 0.2, 10.0), material=name)
    BUILDINGS[name] = turned, oblique, sheet


STEP_M = 1e-3


def round_edge(rays: Rays, edge: int, radius_m: float) -> tuple[Floats, Callable[[Floats], Floats]]:
    """A source beside an edge, and the places on a circle round it at some arcs from the first face, m."""
    found = rays.world.surfaces
    tangent, normal = found.tangent[edge], found.normal[found.faces[edge, 0]]
    along = np.cross(tangent, normal)
    foot = 0.5 * (found.start[edge] + found.end[edge])
    source = foot + 5.0 * (math.cos(1.1) * tangent + math.sin(1.1) * normal) + 0.6 * along

    def places(arc_m: Floats) -> Floats:
        angle = arc_m / radius_m
        return np.asarray(foot + radius_m * (np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * normal))

    return source, places


def boundaries(rays: Rays, source: Floats, places: Callable[[Floats], Floats], end_m: float) -> list[float]:
    """Arcs before which the number of paths other than those over edges changes, to `STEP_M`."""

    def changes(arcs: Floats) -> list[int]:
        found = trace_paths(rays, source, places(arcs)).table
        return np.flatnonzero(np.diff(np.bincount(found.pair, minlength=len(arcs)))).tolist()

    coarse = np.arange(0.02, end_m - 0.02, 0.05)
    found = []
    for k in changes(coarse):
        fine = np.arange(coarse[k] - STEP_M, coarse[k + 1] + STEP_M, STEP_M)
        found += [float(fine[at]) for at in changes(fine)]
    return found


@pytest.mark.parametrize("number", [0, 1, 2])
def test_field_is_continuous_across_all_boundaries(number: int) -> None:
    """Where direct or reflected paths begin or end, 1 mm changes the level by at most 0.1 dB beyond the slope beside it."""
    straight = rays_among(BUILDINGS["metal"][number], diffraction=False)
    found = straight.world.surfaces
    run = found.end - found.start
    edges = {round(abs(float(each[2])) / math.hypot(*each)): k for k, each in enumerate(run)}
    for edge in edges.values():  # level and vertical
        source, places = round_edge(straight, edge, 1.0)
        steps = boundaries(straight, source, places, math.pi * found.angle[edge])
        assert steps
        for solids in BUILDINGS.values():
            rays = rays_among(solids[number])
            for arc in steps:
                level = 20.0 * np.log10(np.abs(field(rays, source, places(arc + STEP_M * np.arange(-1.0, 3.0)))))
                step = np.abs(np.diff(level))
                assert step[1] - max(step[0], step[2]) < 0.1


def test_levels_are_equal_in_both_directions() -> None:
    rng = np.random.default_rng(2)
    solids = (
        Box(center=(0.0, 0.0, 5.0), size=(20.0, 10.0, 10.0), yaw_rad=0.3),
        Box(center=(30.0, 5.0, 4.0), size=(15.0, 12.0, 8.0), material="brick", yaw_rad=-0.4),
        Prism(outline=((10, 20), (30, 20), (30, 30), (20, 30), (20, 40), (10, 40)), height=9.0, material="glass"),
        Box(center=(-10.0, 20.0, 1.5), size=(12.0, 0.2, 3.0), material="plasterboard"),
    )
    rays = rays_among(*solids, ground="wet_ground")
    places = rng.uniform([-20.0, -20.0, 0.2], [50.0, 50.0, 14.0], (120, 3))
    places = places[[not holder for holder in rays.holder(places)]][:80]
    there, back = (trace_paths(rays, places[first : first + 40], places[40 - first : 80 - first]) for first in (0, 40))
    powers = [np.bincount(each.table.pair, np.abs(each.table.gain) ** 2, 40) for each in (there, back)]
    assert np.bincount(there.table.pair, minlength=40).tolist() == np.bincount(back.table.pair, minlength=40).tolist()
    reached = powers[0] > 0.0
    assert reached.sum() > 20
    assert np.abs(10.0 * np.log10(powers[0][reached] / powers[1][reached])).max() < 1e-9


def test_an_edge_behind_the_metal_is_no_path() -> None:
    found = trace_paths(rays_among(CORNER), [5.0, 3.0, 0.0], [200.0, -3000.0, 0.0])
    assert not len(found.table.pair)
