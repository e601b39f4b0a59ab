"""From paths to gains: the field of a wave along each path, from one vertically polarised isotropic antenna to the other.

The gain is the factor from the sent to the received wave, exp(+j w t), with free space and travel::

    gain = lambda / (4 pi) A exp(-j k L) e_b . D_n ... D_1 e_a

e is the unit vector of the antenna's polarisation, D the dyad of each interaction, L the whole length and A the spreading:
1 / L, or behind an edge ``sqrt(1 / (s' s (s' + s)))`` with the lengths s' and s before and behind it.
"""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.util.surfaces import SHEET
from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.rays.coefficients import Complex, Echoes, Surface, Wedge, diffraction, half_space, slab
from vcmvsp.netsim.propagation.rays.tracer import PathTable, legs_of, lengths_of
from vcmvsp.netsim.propagation.rays.world import RayWorld

_LEAST = 1e-12  # of a squared sine: below it a direction is that of the axis


class Wave(NamedTuple):
    """A carrier, and how the echoes in slabs add up."""

    frequency_hz: float
    echoes: Echoes

    @property
    def length_m(self) -> float:
        """Wavelength."""
        return SPEED_OF_LIGHT / self.frequency_hz


class Gains(NamedTuple):
    """Gains of n paths."""

    gain: Complex  # (n,)
    length_m: Floats  # (n,)


def gains(world: RayWorld, table: PathTable, a: Floats, b: Floats, wave: Wave) -> Gains:
    """Gains of paths between points a (P, 3) m and b (P, 3) m."""
    points = legs_of(table, a, b)
    legs = lengths_of(points)
    length = legs.sum(axis=1)
    n, most = table.element.shape
    runs = np.diff(points, axis=1)
    rays = runs / np.where(legs > 0.0, legs, 1.0)[..., None]  # (n, M + 1, 3)
    field = _polarisation(rays[:, 0]).astype(np.complex128)
    nearest_m = wave.length_m / (4.0 * math.pi)  # antennas that are nearer would have a gain
    spreading = 1.0 / np.maximum(length, nearest_m)
    passes = _passes_by_leg(table, most + 1)
    for k in range(most + 1):
        for some in passes[k]:
            path, facet = table.pass_path[some], table.pass_facet[some]
            field[path] = _passed(world, facet, rays[path, k], field[path], wave)
        if k == most:
            break
        active = table.steps > k
        (reflected,) = np.nonzero(active & (table.element[:, k] >= 0))
        if len(reflected):
            facet = table.element[reflected, k]
            field[reflected] = _reflected(world, facet, rays[reflected, k], field[reflected], wave)
        (diffracted,) = np.nonzero(active & (table.element[:, k] < 0))
        if len(diffracted):
            edge = -1 - table.element[diffracted, k]
            before, behind = legs[diffracted, : k + 1].sum(axis=1), legs[diffracted, k + 1 :].sum(axis=1)
            ends = rays[diffracted, k], rays[diffracted, k + 1]
            field[diffracted] = _diffracted(world, edge, ends, (before, behind), field[diffracted], wave)
            spreading[diffracted] = 1.0 / np.sqrt(before * behind * (before + behind))
    last = rays[np.arange(n), table.steps]
    received = (field * _polarisation(last)).sum(axis=1)
    turns = length / wave.length_m
    travel = np.exp(-2j * math.pi * (turns - np.floor(turns)))
    return Gains(wave.length_m / (4.0 * math.pi) * spreading * travel * received, length)


def _passes_by_leg(table: PathTable, legs: int) -> list[list[Ints]]:
    """Passages of each leg, in groups with at most one of each path, in order."""
    groups: list[list[Ints]] = []
    for leg in range(legs):
        (left,) = np.nonzero(table.pass_leg == leg)
        groups.append([])
        while len(left):
            paths = table.pass_path[left]
            is_first = np.concatenate([[True], paths[1:] != paths[:-1]])
            groups[-1].append(left[is_first])
            left = left[~is_first]
    return groups


def _polarisation(ray: Floats) -> Floats:
    """Vertical polarisation of rays (n, 3), across each: upwards is negative (theta of spherical coordinates)."""
    across2 = ray[:, 0] ** 2 + ray[:, 1] ** 2
    across = np.sqrt(np.maximum(across2, _LEAST))
    level = across2 > _LEAST
    east, north = np.where(level, ray[:, 0] / across, 1.0), np.where(level, ray[:, 1] / across, 0.0)
    up = ray[:, 2]
    return np.stack([up * east, up * north, -np.where(level, across, 0.0)], axis=1)


def _frame(ray: Floats, normal: Floats) -> tuple[Floats, Floats, Floats]:
    """Cosine of incidence, and the directions across the plane of incidence and in it, (n,), (n, 3) each."""
    across = _cross(ray, normal)
    sine2 = _dot(across, across)
    # At normal incidence any direction across will do.
    other = _cross(ray, np.where(np.abs(ray[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    across = np.where(sine2[:, None] > _LEAST, across, other)
    across /= np.sqrt(_dot(across, across))[:, None]
    return np.abs(_dot(ray, normal)), across, _cross(across, ray)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _dot_field(field: Complex, direction: Floats) -> Complex:
    return np.asarray(field[:, 0] * direction[:, 0] + field[:, 1] * direction[:, 1] + field[:, 2] * direction[:, 2])


def _cross(a: Floats, b: Floats) -> Floats:
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.stack([x, y, z], axis=1)


def _reflected(world: RayWorld, facet: Ints, ray: Floats, field: Complex, wave: Wave) -> Complex:
    normal = world.normal[facet]
    cosine, across, within = _frame(ray, normal)
    size = world.thickness_m[facet] / wave.length_m
    if np.isinf(size).all():
        reflected = half_space(cosine, world.permittivity[facet])
    else:
        reflected, _ = slab(cosine, world.permittivity[facet], size, wave.echoes)
    away = _cross(across, ray - 2.0 * _dot(ray, normal)[:, None] * normal)
    perpendicular = reflected.perpendicular * _dot_field(field, across)
    parallel = reflected.parallel * _dot_field(field, within)
    return perpendicular[:, None] * across + parallel[:, None] * away


def _passed(world: RayWorld, facet: Ints, ray: Floats, field: Complex, wave: Wave) -> Complex:
    """A sheet is passed at the angle of the ray, another thin solid as a slab at normal incidence."""
    cosine, across, within = _frame(ray, world.normal[facet])
    cosine = np.where(world.terrain.passage[facet] == SHEET, cosine, 1.0)
    _, through = slab(cosine, world.permittivity[facet], world.thickness_m[facet] / wave.length_m, wave.echoes)
    perpendicular = through.perpendicular * _dot_field(field, across)
    parallel = through.parallel * _dot_field(field, within)
    return perpendicular[:, None] * across + parallel[:, None] * within


def _diffracted(
    world: RayWorld, edge: Ints, rays: tuple[Floats, Floats], lengths: tuple[Floats, Floats], field: Complex, wave: Wave
) -> Complex:
    """The field behind edges, without spreading.

    Its vectors are those of Kouyoumjian and Pathak 1974, equations 8 to 11: phi across the plane of edge and ray, beta in it.
    """
    arriving, leaving = rays
    before, behind = lengths
    along, tangent, faces = world.edge_along[edge], world.edge_tangent[edge], world.edge_faces[edge]
    normal = world.normal[faces[:, 0]]
    cosine = _dot(arriving, along)
    phi0 = np.arctan2(-_dot(arriving, normal), -_dot(arriving, tangent)) % (2.0 * math.pi)
    phi = np.arctan2(_dot(leaving, normal), _dot(leaving, tangent)) % (2.0 * math.pi)
    wave_number = 2.0 * math.pi / wave.length_m
    distance = wave_number * before * behind / (before + behind) * np.maximum(1.0 - cosine**2, 1e-12)
    wedge = Wedge(world.edge_angle[edge], phi0, phi, cosine, distance)
    surfaces = [
        Surface(world.permittivity[face], world.thickness_m[face] / wave.length_m, wave.echoes)
        for face in (faces[:, 0], faces[:, 1])
    ]
    dyad = diffraction(wedge, (surfaces[0], surfaces[1]), wave_number)
    phi_in = -_cross(along, arriving)
    phi_in /= np.sqrt(_dot(phi_in, phi_in))[:, None]
    beta_in = _cross(phi_in, arriving)
    phi_out = _cross(along, leaving)
    phi_out /= np.sqrt(_dot(phi_out, phi_out))[:, None]
    beta_out = _cross(phi_out, leaving)
    beta, phi_part = _dot_field(field, beta_in), _dot_field(field, phi_in)
    to_beta, to_phi = dyad[0] * beta + dyad[1] * phi_part, dyad[2] * beta + dyad[3] * phi_part
    return to_beta[:, None] * beta_out + to_phi[:, None] * phi_out
