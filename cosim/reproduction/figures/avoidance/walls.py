"""Walls with doors."""

import math
from collections.abc import Sequence
from typing import Any


def pieces(doors: Sequence[tuple[float, float]], end: float) -> list[tuple[float, float]]:
    """From where to where there is wall, m."""
    edges = [-end, *(edge for middle, width in sorted(doors) for edge in (middle - 0.5 * width, middle + 0.5 * width)), end]
    return list(zip(edges[::2], edges[1::2], strict=True))


def box(x: float, y: float, low: float, high: float, tilt: float, thick: float = 0.02, height: float = 1.0) -> dict[str, Any]:
    """A piece of a wall that is turned about (x, y)."""
    along = 0.5 * (low + high)
    center = (x - along * math.sin(tilt), y + along * math.cos(tilt), 0.5 * height)
    return {"center": center, "size": (thick, high - low, height), "yaw_rad": tilt}
