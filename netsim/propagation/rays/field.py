"""The field of a wave along a path, from one vertically polarised isotropic antenna to the other.

The gain is the factor from the sent to the received wave, exp(+j w t), with free space and travel::

    gain = lambda / (4 pi) A exp(-j k L) e_b . D_n ... D_1 e_a

e is the unit vector of the antenna's polarisation, D the dyad of each interaction, L the whole length and A the spreading:
1 / L, or behind an edge ``sqrt(1 / (s' s (s' + s)))`` with the lengths s' and s before and behind it. The code runs interpreted
or compiled, see `cosim.compiled`.
"""

import math
from math import atan2, cos, sin

from vcmvsp.cosim.util.surfaces import SHEET
from vcmvsp.netsim.propagation.rays.arrays import Terrain, Work
from vcmvsp.netsim.propagation.rays.coefficients import (
    PI,
    at_boundary,
    half_space,
    mirror_dyad,
    passage_dyad,
    slab,
    to_face,
)

LEAST = 1e-12  # of a squared sine: below it a direction is that of the axis

Vector = tuple[float, float, float]
Wave = tuple[complex, complex, complex]
"""Components of the electric field along x, y and z."""


def weigh(w: Terrain, s: Work, count: int, first_pass: int, end_pass: int) -> None:
    """Set `Work.wave` for the path under test over the first ``count`` points, with these passages, sorted by place."""
    length = 0.0
    x, y, z = s.end_x[0], s.end_y[0], s.end_z[0]
    for k in range(count + 1):
        length += size(s.point_x[k] - x, s.point_y[k] - y, s.point_z[k] - z)
        x, y, z = s.point_x[k], s.point_y[k], s.point_z[k]
    # Antennas that are nearer would have a gain.
    spreading = 1.0 / max(length, w.wave_m / (4.0 * PI))
    before, arriving, wave = 0.0, (0.0, 0.0, 0.0), (0j, 0j, 0j)
    x, y, z = s.end_x[0], s.end_y[0], s.end_z[0]
    n = first_pass
    for k in range(count + 1):
        leg = size(s.point_x[k] - x, s.point_y[k] - y, s.point_z[k] - z)
        by = leg if leg > 0.0 else 1.0
        ray = ((s.point_x[k] - x) / by, (s.point_y[k] - y) / by, (s.point_z[k] - z) / by)
        if k == 0:
            up = polarisation(ray)
            wave = (complex(up[0], 0.0), complex(up[1], 0.0), complex(up[2], 0.0))
        elif s.element[k - 1] >= 0:
            wave = reflected(w, s.element[k - 1], arriving, wave)
        else:
            behind = length - before
            wave = diffracted(w, -1 - s.element[k - 1], arriving, ray, before * behind / length, wave)
            spreading = 1.0 / math.sqrt(before * behind * length)
        while n < end_pass and s.pass_leg[n] == k:
            wave = gone_through(w, s.pass_facet[n], ray, wave)
            n += 1
        before += leg
        arriving = ray
        x, y, z = s.point_x[k], s.point_y[k], s.point_z[k]
    received = along(wave, polarisation(arriving))
    turns = length / w.wave_m
    phase = -2.0 * PI * (turns - math.floor(turns))
    real, imag = cos(phase), sin(phase)
    factor = w.wave_m / (4.0 * PI) * spreading
    s.wave[0] = factor * (received.real * real - received.imag * imag)
    s.wave[1] = factor * (received.real * imag + received.imag * real)
    s.wave[2] = length


def size(x: float, y: float, z: float) -> float:
    """Length of a vector; a power of 2 would not be the same to the bit interpreted and compiled."""
    return math.sqrt(x * x + y * y + z * z)


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross_of(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def unit(a: Vector) -> Vector:
    """Direction of a vector that is not 0."""
    length = size(a[0], a[1], a[2])
    return a[0] / length, a[1] / length, a[2] / length


def along(wave: Wave, direction: Vector) -> complex:
    """Part of a wave in a direction."""
    real = wave[0].real * direction[0] + wave[1].real * direction[1] + wave[2].real * direction[2]
    imag = wave[0].imag * direction[0] + wave[1].imag * direction[1] + wave[2].imag * direction[2]
    return complex(real, imag)


def made_of(p: complex, u: Vector, q: complex, v: Vector) -> Wave:
    """The wave with these parts in two directions."""
    return (
        complex(p.real * u[0] + q.real * v[0], p.imag * u[0] + q.imag * v[0]),
        complex(p.real * u[1] + q.real * v[1], p.imag * u[1] + q.imag * v[1]),
        complex(p.real * u[2] + q.real * v[2], p.imag * u[2] + q.imag * v[2]),
    )


def polarisation(ray: Vector) -> Vector:
    """Vertical polarisation of a ray, across it: upwards is negative (theta of spherical coordinates)."""
    across = ray[0] * ray[0] + ray[1] * ray[1]
    if across <= LEAST:
        return ray[2], 0.0, 0.0
    across = math.sqrt(across)
    return ray[2] * ray[0] / across, ray[2] * ray[1] / across, -across


def across_incidence(ray: Vector, normal: Vector) -> Vector:
    """Unit vector across the plane of incidence; at normal incidence any direction across the ray will do."""
    across = cross_of(ray, normal)
    if dot(across, across) <= LEAST:
        across = cross_of(ray, (0.0, 0.0, 1.0) if abs(ray[2]) < 0.9 else (1.0, 0.0, 0.0))
    return unit(across)


def normal_of(w: Terrain, f: int) -> Vector:
    """Outward normal of a facet."""
    return w.normal_x[f], w.normal_y[f], w.normal_z[f]


def eta_of(w: Terrain, f: int) -> complex:
    """Permittivity of a facet."""
    return complex(w.eta_real[f], w.eta_imag[f])


def face_of(w: Terrain, f: int, cosine: float) -> tuple[complex, complex]:
    """Reflection coefficients of a facet, perpendicular and parallel."""
    if w.turns[f] == math.inf:
        perpendicular, parallel, _ = half_space(cosine, eta_of(w, f))
    else:
        perpendicular, parallel, _, _ = slab(cosine, eta_of(w, f), w.turns[f], w.averaged)
    return perpendicular, parallel


def passage_of(w: Terrain, f: int, cosine: float) -> tuple[complex, complex]:
    """Transmission coefficients of a facet, perpendicular and parallel."""
    _, _, perpendicular, parallel = slab(cosine, eta_of(w, f), w.turns[f], w.averaged)
    return perpendicular, parallel


def reflected(w: Terrain, f: int, ray: Vector, wave: Wave) -> Wave:
    """The wave behind a reflection."""
    normal = normal_of(w, f)
    facing = dot(ray, normal)
    across = across_incidence(ray, normal)
    perpendicular, parallel = face_of(w, f, abs(facing))
    perpendicular = perpendicular * along(wave, across)
    parallel = parallel * along(wave, cross_of(across, ray))
    away = (ray[0] - 2.0 * facing * normal[0], ray[1] - 2.0 * facing * normal[1], ray[2] - 2.0 * facing * normal[2])
    return made_of(perpendicular, across, parallel, cross_of(across, away))


def gone_through(w: Terrain, f: int, ray: Vector, wave: Wave) -> Wave:
    """The wave behind a slab. A sheet is passed at the angle of the ray, another thin solid as a slab at normal incidence."""
    normal = normal_of(w, f)
    across = across_incidence(ray, normal)
    perpendicular, parallel = passage_of(w, f, abs(dot(ray, normal)) if w.passage[f] == SHEET else 1.0)
    within_plane = cross_of(across, ray)
    return made_of(perpendicular * along(wave, across), across, parallel * along(wave, within_plane), within_plane)


def diffracted(w: Terrain, e: int, arriving: Vector, leaving: Vector, distance_m: float, wave: Wave) -> Wave:
    """The wave behind an edge, without spreading.

    The dyad has the four terms of R. G. Kouyoumjian and P. H. Pathak, A uniform geometrical theory of diffraction for an edge
    in a perfectly conducting surface, Proc. IEEE 62, 1974, equations 25 to 31::

        g = cot((pi +- (phi -+ phi')) / 2 n) F(k L a(phi -+ phi'))

    each with the dyad of what it makes continuous: the two of the shadow boundary with ``1 - T``, as beyond it the wave that
    passes remains (W. D. Burnside, K. W. Burgener, High frequency scattering by a thin lossless dielectric slab, IEEE TAP 31,
    1983); the two of the reflection boundaries with the reflection dyad R of the face (R. J. Luebbers, Finite conductivity
    uniform GTD versus knife edge diffraction, IEEE TAP 32, 1984). The angle of incidence of R is that of the ray nearer to the
    face: on the boundary it is exact, and both directions agree. The vectors are those of equations 8 to 11: phi across the
    plane of edge and ray, beta in it.

    Args:
        w: the world.
        e: the edge.
        arriving: direction of the ray before it.
        leaving: direction of the ray behind it.
        distance_m: ``s s' / (s + s')`` of the lengths before and behind it.
        wave: that arrives.
    """
    edge = (w.along_x[e], w.along_y[e], w.along_z[e])
    tangent = (w.tangent_x[e], w.tangent_y[e], w.tangent_z[e])
    first, second, n = w.first_face[e], w.second_face[e], w.angle[e]
    normal = normal_of(w, first)
    cosine = dot(arriving, edge)
    sine2 = max(1.0 - cosine * cosine, 1e-12)
    sine = math.sqrt(sine2)
    # Angles count from the first face, through the outside, to the second at n pi.
    phi0, phi = (
        full_turn(-dot(arriving, normal), -dot(arriving, tangent)),
        full_turn(dot(leaving, normal), dot(leaving, tangent)),
    )
    wave_number = 2.0 * PI / w.wave_m
    distance = wave_number * distance_m * sine2
    shadow = at_boundary(n, 1.0, phi - phi0, distance, w.faddeeva) + at_boundary(n, -1.0, phi - phi0, distance, w.faddeeva)
    over_second = at_boundary(n, 1.0, phi + phi0, distance, w.faddeeva)
    over_first = at_boundary(n, -1.0, phi + phi0, distance, w.faddeeva)
    front = mirror_dyad(phi0, phi, cosine, sine, face_of(w, first, sine * to_face(phi0, phi)))
    rest0, rest = n * PI - phi0, n * PI - phi
    back = mirror_dyad(rest0, rest, -cosine, sine, face_of(w, second, sine * to_face(rest0, rest)))
    beta_beta = over_second * back[0] + over_first * front[0] - shadow
    beta_phi = over_second * back[1] + over_first * front[1]
    phi_beta = -beta_phi
    phi_phi = over_second * back[2] + over_first * front[2] - shadow
    if w.turns[first] != math.inf:
        angle = 0.5 * (phi + phi0 - PI)
        passed = passage_dyad(angle, cosine, sine, passage_of(w, first, sine * abs(sin(angle))))
        beta_beta += shadow * passed[0]
        beta_phi += shadow * passed[1]
        phi_beta += shadow * passed[1]
        phi_phi += shadow * passed[2]
    phi_in, phi_out = unit(cross_of(arriving, edge)), unit(cross_of(edge, leaving))
    beta_out = cross_of(phi_out, leaving)
    beta, across = along(wave, cross_of(phi_in, arriving)), along(wave, phi_in)
    size_of = -1.0 / (2.0 * n * math.sqrt(2.0 * PI * wave_number) * sine)
    factor = complex(size_of * math.sqrt(0.5), -size_of * math.sqrt(0.5))  # with exp(-j pi / 4)
    to_beta = factor * (beta_beta * beta + beta_phi * across)
    to_phi = factor * (phi_beta * beta + phi_phi * across)
    return made_of(to_beta, beta_out, to_phi, phi_out)


def full_turn(y: float, x: float) -> float:
    """Angle of a direction, 0 to 2 pi."""
    angle = atan2(y, x)
    return angle + 2.0 * PI if angle < 0.0 else angle
