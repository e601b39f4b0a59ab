"""Positioning systems of real robots: their messages become `Located`. Filters and fusion are in `cosim.estimation`."""

import msgspec

from vcmvsp.cosim.types import Vec3


class Located(msgspec.Struct, frozen=True, kw_only=True):
    """One answer of a positioning system."""

    tag: str = ""  # number or name of the tag; empty: the only one of the port
    position: Vec3 | None = None  # m, in the system's own frame (GPS: of the tangent plane); None: no position now
    velocity: tuple[float, float] | None = None  # m/s, east and north
    sigma_m: float | None = None  # standard deviation of x and y; None: not in the message
    quality: float | None = None  # 0 to 1, where the system gives such a number
    source_ns: int | None = None  # time of the measurement, of the system's clock; None: not in the message
