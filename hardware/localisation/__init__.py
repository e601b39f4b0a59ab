"""Positioning systems of real robots: their messages become `Located`. Filters and fusion are in `cosim.estimation`.

Every system has a ``Reader`` with one verb, ``feed(chunk) -> list[Located]``. It takes the bytes of a port or a socket as they
came; what it cannot read it counts, and never raises.
"""

import msgspec

from vcmvsp.cosim.types import Vec3


class Located(msgspec.Struct, frozen=True, kw_only=True):
    """One answer of a positioning system."""

    tag: str = ""  # whose; empty: of whatever the port belongs to
    position: Vec3 | None = None  # m, in the system's own frame (GPS: of the tangent plane); None: it has none now
    velocity: tuple[float, float] | None = None  # m/s, east and north
    sigma_m: float | None = None  # standard deviation of x and y; None: it does not say
    quality: float | None = None  # 0 to 1, where the system gives such a number
    source_ns: int | None = None  # when it was measured by the system's own clock; None: it does not say
