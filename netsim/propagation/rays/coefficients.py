"""Reflection and transmission coefficients of half-spaces and slabs, and the diffraction coefficient of a wedge.

Time goes as exp(+j w t). ``perpendicular`` and ``parallel`` are the directions of the electric field to the plane of incidence.
The functions of single numbers run interpreted or compiled, see `cosim.compiled`.
"""

import math
from math import cos, exp, sin
from typing import Literal

from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS

Echoes = Literal["phases", "averaged"]

GROUNDS: dict[str, tuple[float, float, float, float]] = {
    "very_dry_ground": (3.0, 0.0, 0.00015, 2.52),
    "medium_dry_ground": (15.0, -0.1, 0.035, 1.63),
    "wet_ground": (30.0, -0.4, 0.15, 1.30),
}
"""ITU-R P.2040-3, table 3, as `ITU_MATERIALS`: 1 to 10 GHz."""

MATERIALS = {**ITU_MATERIALS, **GROUNDS}

PI = math.pi
ROOT_PI = math.sqrt(math.pi)
ON_BOUNDARY = 1e-10  # rad: nearer to a boundary than this counts as this
FAR = 6.0  # square root of the argument from which the transition function is its series
ORDER = 32  # of the rational function that is the Faddeeva function
STRETCH = math.sqrt(ORDER / math.sqrt(2.0))  # its number L


def permittivity(material: str, frequency_hz: float) -> complex:
    """Relative permittivity, ``a f^b - j 17.98 c f^d / f``, f in GHz (ITU-R P.2040-3, equations 28, 29 and 59).

    ``material`` is one of the `MATERIALS`.
    """
    a, b, c, d = MATERIALS[material]
    gigahertz = frequency_hz * 1e-9
    return complex(a * gigahertz**b, -17.98 * c * gigahertz**d / gigahertz)


def squared(z: complex) -> float:
    """Square of the size of a number."""
    return z.real * z.real + z.imag * z.imag


def half_space(cosine: float, eta: complex) -> tuple[complex, complex, complex]:
    """Reflection at a half-space, perpendicular and parallel (Fresnel; ITU-R P.2040-3, equations 35 and 36).

    Args:
        cosine: of the angle between ray and normal.
        eta: relative permittivity; its real part is positive, its imaginary part is not.

    Returns:
        Both coefficients, and ``sqrt(eta - sin^2)``.
    """
    real, imag = eta.real - (1.0 - cosine * cosine), eta.imag
    root = math.sqrt(0.5 * (math.sqrt(real * real + imag * imag) + real))
    inside = complex(root, 0.5 * imag / root)
    outside = complex(eta.real * cosine, eta.imag * cosine)
    face = complex(cosine, 0.0)
    return (face - inside) / (face + inside), (outside - inside) / (outside + inside), inside


def slab(cosine: float, eta: complex, turns: float, averaged: int) -> tuple[complex, complex, complex, complex]:
    """Reflection and transmission of a slab, perpendicular and parallel each (ITU-R P.2040-3, equations 43 and 44).

    ::

        q = 2 pi d / lambda sqrt(eta - sin^2)
        R = R' (1 - exp(-2 j q)) / (1 - R'^2 exp(-2 j q)),   T = (1 - R'^2) exp(-j q) / (1 - R'^2 exp(-2 j q))

    With averaged echoes the powers of all echoes are added instead, as in `netsim.propagation.walls.slab_loss_db`, and the
    phases are those of the first.

    Args:
        cosine: of the angle between ray and normal.
        eta: relative permittivity.
        turns: thickness in wavelengths of free space; infinite: a half-space.
        averaged: whether the powers of the echoes add up, not their waves.
    """
    perpendicular, parallel, inside = half_space(cosine, eta)
    if turns == math.inf:
        return perpendicular, parallel, 0j, 0j
    size, phase = exp(2.0 * PI * turns * inside.imag), 2.0 * PI * turns * inside.real
    once = complex(size * cos(phase), -size * sin(phase))
    if averaged:
        back, through = averaged_echoes(perpendicular, once)
        other_back, other_through = averaged_echoes(parallel, once)
    else:
        back, through = echoes_with_phases(perpendicular, once)
        other_back, other_through = echoes_with_phases(parallel, once)
    return back, other_back, through, other_through


def echoes_with_phases(face: complex, once: complex) -> tuple[complex, complex]:
    """R and T from the reflection at one face and the factor of one passage."""
    square, twice = face * face, once * once
    rest = 1.0 - square * twice
    return face * (1.0 - twice) / rest, (1.0 - square) * once / rest


def averaged_echoes(face: complex, once: complex) -> tuple[complex, complex]:
    """R and T as of `echoes_with_phases`, but from the powers of all echoes, with the phases of the first ones."""
    square = face * face
    power, passage, through = squared(face), squared(once), squared(1.0 - square)
    rest = 1.0 - power * passage * power * passage
    reflected = power + through * passage * passage * power / rest
    return sized(face, math.sqrt(reflected)), sized((1.0 - square) * once, math.sqrt(through * passage / rest))


def sized(z: complex, size: float) -> complex:
    """A number of this size in the direction of another; that of 0 is real."""
    length = math.sqrt(squared(z))
    return complex(z.real / length * size, z.imag / length * size) if length > 0.0 else complex(size, 0.0)


def mirror_dyad(
    arriving: float, leaving: float, cosine: float, sine: float, reflected: tuple[complex, complex]
) -> tuple[complex, complex, complex]:
    """Reflection in coordinates of the edge, ray-fixed (beta, phi) by (beta, phi): the entries 00, 01 and 11; 10 is -01.

    With the exact angles of a reflection, ``leaving = pi - arriving``, it is the reflection of the face. Exchanged rays give
    the transposed dyad.

    Args:
        arriving: angle of the ray to the face, rad.
        leaving: likewise.
        cosine: of the angle between ray and edge.
        sine: of it.
        reflected: by the face at the angle `to_face`, perpendicular and parallel.
    """
    perpendicular, parallel = reflected
    up = to_face(arriving, leaving)
    rest = max(1.0 - sine * up * sine * up, 1e-12)  # squared sine of the angle of incidence
    across = cosine * up * cosine * up / rest
    mixed = 0.5 * (cos(arriving) - cos(leaving)) * cosine * up / rest
    return (
        across * parallel - (1.0 - across) * perpendicular,
        mixed * (perpendicular + parallel),
        across * perpendicular - (1.0 - across) * parallel,
    )


def to_face(arriving: float, leaving: float) -> float:
    """Sine of the angle to a face that it reflects at: that of the ray nearer to it, at most 90 degrees."""
    return sin(min(max(min(arriving, leaving), 0.0), 0.5 * PI))


def passage_dyad(
    angle: float, cosine: float, sine: float, through: tuple[complex, complex]
) -> tuple[complex, complex, complex]:
    """Transmission in coordinates of the edge for a ray at this angle to the face, rad: the entries 00, 01 = 10 and 11."""
    perpendicular, parallel = through
    up = sin(angle)
    rest = max(1.0 - sine * up * sine * up, 1e-12)
    across = cosine * up * cosine * up / rest
    mixed = cos(angle) * up * cosine / rest
    return (
        (1.0 - across) * perpendicular + across * parallel,
        mixed * (parallel - perpendicular),
        across * perpendicular + (1.0 - across) * parallel,
    )


def at_boundary(n: float, sign: float, angle: float, distance: float, numbers: Floats) -> complex:
    """``cot((pi + sign angle) / 2 n) F(k L a(angle))``, continuous where both factors have no value.

    Args:
        n: outer angle of the wedge in units of pi.
        sign: 1 or -1.
        angle: between the rays, or their sum, rad.
        distance: k L.
        numbers: see `faddeeva_numbers`.
    """
    turns = math.floor((angle + sign * PI) / (2.0 * PI * n) + 0.5)
    off = angle + sign * PI - 2.0 * PI * n * turns  # from the nearest boundary, rad
    if abs(off) < ON_BOUNDARY:
        off = ON_BOUNDARY
    # a = 2 cos^2(n pi N - angle / 2) = 2 sin^2(off / 2), cot((pi + sign angle) / 2 n) = sign cot(off / 2 n)
    cot = sign * cos(off / (2.0 * n)) / sin(off / (2.0 * n))
    return cot * fresnel_transition(math.sqrt(2.0 * distance) * abs(sin(0.5 * off)), numbers)


def fresnel_transition(root: float, numbers: Floats) -> complex:
    """Transition function F(x) of the square root of x.

    ::

        F(x) = 2 j sqrt(x) exp(j x) int_sqrt(x)^inf exp(-j t^2) dt = sqrt(pi x) exp(j pi / 4) w(exp(3 j pi / 4) sqrt(x))

    w is the Faddeeva function (M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 1964, 7.1.3), computed as the
    rational function of J. A. C. Weideman, Computation of the complex error function, SIAM J. Numer. Anal. 31, 1994; far from 0
    as its asymptotic series ``sum (2 m - 1)!! (j / 2 x)^m`` (7.1.23).
    """
    if root > FAR:
        t = 0.5 / (root * root)
        square = -t * t
        even = 1.0 + square * (3.0 + square * (105.0 + square * (10395.0 + square * (2027025.0 + square * 654729075.0))))
        odd = 1.0 + square * (15.0 + square * (945.0 + square * (135135.0 + square * 34459425.0)))
        return complex(even, t * odd)
    half = math.sqrt(0.5) * root  # z = half (-1 + j)
    below = complex(STRETCH + half, half)  # L - j z
    turned = complex(STRETCH - half, -half) / below
    total = complex(numbers[0], 0.0)
    for k in range(1, len(numbers)):
        total = total * turned + numbers[k]
    found = (2.0 * total / below + 1.0 / ROOT_PI) / below
    return complex(half, half) * ROOT_PI * found


def faddeeva_numbers() -> list[float]:
    """Coefficients of Weideman's rational function, the highest first: a cosine transform of ``exp(-t^2) (L^2 + t^2)``."""
    angles = [math.pi * k / (2 * ORDER) for k in range(1 - 2 * ORDER, 2 * ORDER)]
    places = [(angle, STRETCH * math.tan(0.5 * angle)) for angle in angles]
    values = [(angle, math.exp(-t * t) * (STRETCH * STRETCH + t * t)) for angle, t in places]

    def number(n: int) -> float:
        return math.fsum(value * math.cos(n * angle) for angle, value in values) / (4 * ORDER)

    return [number(n) for n in range(ORDER, 0, -1)]
