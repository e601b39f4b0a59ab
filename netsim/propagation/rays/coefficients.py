"""Reflection and transmission coefficients of half-spaces and slabs, and the diffraction coefficient of a wedge.

Time goes as exp(+j w t). ``perpendicular`` and ``parallel`` are the directions of the electric field to the plane of incidence.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import wofz

from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS

Complex = NDArray[np.complex128]
Echoes = Literal["phases", "averaged"]

GROUNDS: dict[str, tuple[float, float, float, float]] = {
    "very_dry_ground": (3.0, 0.0, 0.00015, 2.52),
    "medium_dry_ground": (15.0, -0.1, 0.035, 1.63),
    "wet_ground": (30.0, -0.4, 0.15, 1.30),
}
"""ITU-R P.2040-3, table 3, as `ITU_MATERIALS`: 1 to 10 GHz."""

MATERIALS = {**ITU_MATERIALS, **GROUNDS}


class Pair(NamedTuple):
    """A coefficient for both polarisations, (n,) each."""

    perpendicular: Complex
    parallel: Complex


def permittivity(material: str, frequency_hz: float) -> complex:
    """Relative permittivity, ``a f^b - j 17.98 c f^d / f``, f in GHz (ITU-R P.2040-3, equations 28, 29 and 59).

    ``material`` is one of the `MATERIALS`.
    """
    a, b, c, d = MATERIALS[material]
    gigahertz = frequency_hz * 1e-9
    return complex(a * gigahertz**b, -17.98 * c * gigahertz**d / gigahertz)


def half_space(cosine: Floats, permittivity: Complex) -> Pair:
    """Reflection at a half-space (Fresnel; ITU-R P.2040-3, equations 35 and 36).

    Args:
        cosine: of the angle between ray and normal, (n,).
        permittivity: relative, complex, (n,).
    """
    inside = np.sqrt(permittivity - (1.0 - cosine * cosine))
    outside = permittivity * cosine
    perpendicular, parallel = (cosine - inside) / (cosine + inside), (outside - inside) / (outside + inside)
    return Pair(np.asarray(perpendicular, np.complex128), np.asarray(parallel, np.complex128))


def slab(cosine: Floats, permittivity: Complex, size_turns: Floats, echoes: Echoes) -> tuple[Pair, Pair]:
    """Reflection and transmission of a slab (ITU-R P.2040-3, equations 43 and 44).

    ::

        q = 2 pi d / lambda sqrt(eta - sin^2)
        R = R' (1 - exp(-2 j q)) / (1 - R'^2 exp(-2 j q)),   T = (1 - R'^2) exp(-j q) / (1 - R'^2 exp(-2 j q))

    With ``averaged`` echoes the powers of all echoes are added instead, as in `netsim.propagation.walls.slab_loss_db`, and the
    phases are those of the first.

    Args:
        cosine: of the angle between ray and normal, (n,).
        permittivity: relative, complex, (n,).
        size_turns: thickness in wavelengths of free space, (n,); infinite: a half-space.
        echoes: how the echoes add up.
    """
    face = half_space(cosine, permittivity)
    inside = np.sqrt(permittivity - (1.0 - cosine * cosine))
    endless = np.isinf(size_turns)
    once = np.where(endless, 0.0, np.exp(-2j * math.pi * np.where(endless, 0.0, size_turns) * inside))
    found = [_slab_of(each, once, echoes) for each in face]
    return Pair(found[0][0], found[1][0]), Pair(found[0][1], found[1][1])


def _slab_of(face: Complex, once: Complex, echoes: Echoes) -> tuple[Complex, Complex]:
    """R and T from the reflection at one face and the factor of one passage."""
    square = face * face
    if echoes == "phases":
        rest = 1.0 - square * once * once
        return face * (1.0 - once * once) / rest, (1.0 - square) * once / rest
    power, passage, through = np.abs(square), np.abs(once) ** 2, np.abs(1.0 - square) ** 2
    rest_power = 1.0 - (power * passage) ** 2
    reflected = power + through * passage**2 * power / rest_power
    # The phase is that of the first echo.
    size = np.abs(face)
    direction = np.where(size > 0.0, face / np.where(size > 0.0, size, 1.0), 1.0)
    first = (1.0 - square) * once
    length = np.abs(first)
    phase = np.where(length > 0.0, first / np.where(length > 0.0, length, 1.0), 1.0)
    return np.sqrt(reflected) * direction, np.sqrt(through * passage / rest_power) * phase


class Wedge(NamedTuple):
    """Rays at n edges. Angles count from the first face, through the outside, to the second at ``angle pi``, rad."""

    angle: Floats  # (n,) outer angle in units of pi
    arriving: Floats  # (n,) angle of the side from which the ray comes
    leaving: Floats  # (n,) angle of the side to which it goes
    cosine: Floats  # (n,) of the angle between ray and edge, along the edge
    distance: Floats  # (n,) k L: wave number times ``s s' sin^2 / (s + s')``


def diffraction(
    wedge: Wedge, faces: tuple["Surface", "Surface"], wave_number: float
) -> tuple[Complex, Complex, Complex, Complex]:
    """Dyadic diffraction coefficient: rows (beta, phi) of the leaving, columns of the arriving ray, (n,) each, sqrt(m).

    The four terms of R. G. Kouyoumjian and P. H. Pathak, A uniform geometrical theory of diffraction for an edge in a perfectly
    conducting surface, Proc. IEEE 62, 1974, equations 25 to 31::

        g = cot((pi +- (phi -+ phi')) / 2 n) F(k L a(phi -+ phi'))

    each with the dyad of what it makes continuous: the two of the shadow boundary with ``1 - T``, as beyond it the wave that
    passes remains (W. D. Burnside, K. W. Burgener, High frequency scattering by a thin lossless dielectric slab, IEEE TAP 31,
    1983); the two of the reflection boundaries with the reflection dyad R of the face (R. J. Luebbers, Finite conductivity
    uniform GTD versus knife edge diffraction, IEEE TAP 32, 1984). The angle of incidence of R is that of the ray nearer to the
    face: on the boundary it is exact, and both directions agree.
    """
    n, phi, phi0 = wedge.angle, wedge.leaving, wedge.arriving
    sine = np.sqrt(np.maximum(1.0 - wedge.cosine**2, 1e-12))
    factor = -np.exp(-0.25j * math.pi) / (2.0 * n * math.sqrt(2.0 * math.pi * wave_number) * sine)
    shadow = [_transition(n, sign, phi - phi0, wedge.distance) for sign in (1.0, -1.0)]
    over_second, over_first = (_transition(n, sign, phi + phi0, wedge.distance) for sign in (1.0, -1.0))
    first, second = faces
    passed = first.passage_dyad(0.5 * (phi + phi0 - math.pi), wedge.cosine, sine)
    at_first = first.mirror_dyad(phi0, phi, wedge.cosine, sine)
    at_second = second.mirror_dyad(n * math.pi - phi0, n * math.pi - phi, -wedge.cosine, sine)
    gone = shadow[0] + shadow[1]
    unit = (1.0, 0.0, 0.0, 1.0)
    entries = [
        factor * (gone * (through - one) + over_second * back + over_first * front)
        for one, through, back, front in zip(unit, passed, at_second, at_first, strict=True)
    ]
    return entries[0], entries[1], entries[2], entries[3]


class Surface(NamedTuple):
    """Faces of n edges: half-spaces, or slabs."""

    permittivity: Complex  # (n,)
    size_turns: Floats  # (n,) thickness in wavelengths; infinite: a half-space
    echoes: Echoes

    def mirror_dyad(self, arriving: Floats, leaving: Floats, cosine: Floats, sine: Floats) -> list[Complex]:
        """Reflection in coordinates of the edge: ray-fixed (beta, phi) by (beta, phi); angles count from this face, rad.

        With the exact angles of a reflection, ``leaving = pi - arriving``, it is the reflection of the face. Else the angle to
        the face is the smaller of both. Exchanged rays give the transposed dyad.
        """
        nearer = np.clip(np.minimum(arriving, leaving), 0.0, 0.5 * math.pi)
        to_face = np.sin(nearer)
        reflected, _ = slab(sine * to_face, self.permittivity, self.size_turns, self.echoes)
        rest = np.maximum(1.0 - (sine * to_face) ** 2, 1e-12)  # squared sine of the angle of incidence
        across = (cosine * to_face) ** 2 / rest
        along = 1.0 - across
        mixed = 0.5 * (np.cos(arriving) - np.cos(leaving)) * cosine * to_face / rest * (reflected[0] + reflected[1])
        beta = across * reflected.parallel - along * reflected.perpendicular
        phi = across * reflected.perpendicular - along * reflected.parallel
        return [beta, mixed, -mixed, phi]

    def passage_dyad(self, angle: Floats, cosine: Floats, sine: Floats) -> list[Complex]:
        """Transmission in coordinates of the edge for a ray at this angle to the face, rad."""
        _, through = slab(sine * np.abs(np.sin(angle)), self.permittivity, self.size_turns, self.echoes)
        rest = np.maximum(1.0 - (sine * np.sin(angle)) ** 2, 1e-12)
        across = (cosine * np.sin(angle)) ** 2 / rest
        along = 1.0 - across
        mixed = np.cos(angle) * np.sin(angle) * cosine / rest * (through.parallel - through.perpendicular)
        beta = along * through.perpendicular + across * through.parallel
        phi = across * through.perpendicular + along * through.parallel
        return [beta, mixed, mixed, phi]


_ON_BOUNDARY = 1e-10  # rad: nearer to a boundary than this counts as this


def _transition(n: Floats, sign: float, angle: Floats, distance: Floats) -> Complex:
    """``cot((pi + sign angle) / 2 n) F(k L a(angle))``, continuous where both factors have no value."""
    turns = np.rint((angle + sign * math.pi) / (2.0 * math.pi * n))
    off = angle + sign * math.pi - 2.0 * math.pi * n * turns  # from the nearest boundary, rad
    off = np.where(np.abs(off) < _ON_BOUNDARY, _ON_BOUNDARY, off)
    # a = 2 cos^2(n pi N - angle / 2) = 2 sin^2(off / 2), cot((pi + sign angle) / 2 n) = sign cot(off / 2 n)
    root = np.sqrt(2.0 * distance) * np.abs(np.sin(0.5 * off))
    return sign / np.tan(off / (2.0 * n)) * fresnel_transition(root)


def fresnel_transition(root: Floats) -> Complex:
    """Transition function F(x) of the square roots of x.

    ::

        F(x) = 2 j sqrt(x) exp(j x) int_sqrt(x)^inf exp(-j t^2) dt = sqrt(pi x) exp(j pi / 4) w(exp(3 j pi / 4) sqrt(x))

    w is the Faddeeva function (M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 1964, 7.1.3).
    """
    return np.asarray(math.sqrt(math.pi) * np.exp(0.25j * math.pi) * root * wofz(np.exp(0.75j * math.pi) * root))
