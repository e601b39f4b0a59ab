"""A local tangent plane on the WGS 84 ellipsoid: geodetic coordinates to east, north, up and back, both in closed form.

Forward: geodetic to earth-centred coordinates and a rotation. Back: Heikkinen 1982, "Geschlossene Formeln zur Berechnung
räumlicher geodätischer Koordinaten aus rechtwinkligen Koordinaten", Z. Vermessungswesen 107, as Zhu 1994, "Conversion of
earth-centered earth-fixed coordinates to geodetic coordinates", IEEE Trans. AES 30(3), gives it; exact outside a ball of
43 km round the centre of the earth.
"""

import math

from vcmvsp.cosim.types import Vec3

A = 6378137.0  # m, semi-major axis [NIMA TR8350.2, WGS 84]
F = 1.0 / 298.257223563  # flattening [the same]
B = A * (1.0 - F)
E2 = F * (2.0 - F)  # first eccentricity squared


def to_earth(latitude_deg: float, longitude_deg: float, height_m: float) -> Vec3:
    """Earth-centred, earth-fixed coordinates (m) of a point ``height_m`` above the ellipsoid."""
    phi, lam = math.radians(latitude_deg), math.radians(longitude_deg)
    n = A / math.sqrt(1.0 - E2 * math.sin(phi) ** 2)  # radius of curvature in the prime vertical
    across = (n + height_m) * math.cos(phi)
    return across * math.cos(lam), across * math.sin(lam), (n * (1.0 - E2) + height_m) * math.sin(phi)


def from_earth(x: float, y: float, z: float) -> Vec3:
    """Latitude (deg), longitude (deg) and height above the ellipsoid (m) of an earth-centred point (m); letters as in Zhu."""
    p2, z2 = x * x + y * y, z * z
    p = math.sqrt(p2)
    f = 54.0 * B * B * z2
    g = p2 + (1.0 - E2) * z2 - E2 * (A * A - B * B)
    c = E2 * E2 * f * p2 / g**3
    s = (1.0 + c + math.sqrt(c * c + 2.0 * c)) ** (1.0 / 3.0)
    big_p = f / (3.0 * (s + 1.0 + 1.0 / s) ** 2 * g * g)
    q = math.sqrt(1.0 + 2.0 * E2 * E2 * big_p)
    under = 0.5 * A * A * (1.0 + 1.0 / q) - big_p * (1.0 - E2) * z2 / (q * (1.0 + q)) - 0.5 * big_p * p2
    r0 = -big_p * E2 * p / (1.0 + q) + math.sqrt(max(under, 0.0))
    u = math.hypot(p - E2 * r0, z)
    v = math.sqrt((p - E2 * r0) ** 2 + (1.0 - E2) * z2)
    second = (A * A - B * B) / (B * B)  # second eccentricity squared
    latitude = math.atan2(z + second * B * B * z / (A * v), p)
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), u * (1.0 - B * B / (A * v))


class TangentPlane:
    """The plane that touches the ellipsoid's parallel surface at the origin; its axes point east, north and up there."""

    def __init__(self, latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> None:
        if not -90.0 <= latitude_deg <= 90.0:
            raise ValueError(f"a latitude must be from -90 to 90 degrees, not {latitude_deg}")
        self._origin = to_earth(latitude_deg, longitude_deg, height_m)
        phi, lam = math.radians(latitude_deg), math.radians(longitude_deg)
        sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
        self._east, self._north, self._up = (-sl, cl, 0.0), (-sp * cl, -sp * sl, cp), (cp * cl, cp * sl, sp)
        self.height_m = height_m

    def enu(self, latitude_deg: float, longitude_deg: float, height_m: float) -> Vec3:
        """East, north and up (m) of a point; heights are above the ellipsoid."""
        x, y, z = to_earth(latitude_deg, longitude_deg, height_m)
        d = (x - self._origin[0], y - self._origin[1], z - self._origin[2])
        return _dot(self._east, d), _dot(self._north, d), _dot(self._up, d)

    def geodetic(self, east_m: float, north_m: float, up_m: float) -> Vec3:
        """Latitude (deg), longitude (deg) and height above the ellipsoid (m) of a point of the plane's frame."""
        rows = zip(self._origin, self._east, self._north, self._up, strict=True)
        x, y, z = (o + east_m * e + north_m * n + up_m * u for o, e, n, u in rows)
        return from_earth(x, y, z)


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
