"""Surfaces of solids: what the world offers, and the radio's rays meet."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BODY, OPAQUE, SHEET, SKIN = range(4)
"""What passes a facet: nothing, as its convex body stops it; nothing; a slab's share, from both sides; a thin solid's share, on
entering."""


class Surfaces(NamedTuple):
    """F facets (convex polygons), E edges and V upright convex bodies of m solids."""

    first: Ints  # (F + 1,) of the corners of each facet
    corner: Floats  # (K, 3) m, counter-clockwise seen from outside
    normal: Floats  # (F, 3) outward unit normals
    offset: Floats  # (F,) m: ``normal . point`` of the plane
    passage: Ints  # (F,) `BODY`, `OPAQUE`, `SHEET`, `SKIN`
    solid: Ints  # (F,) of which solid
    thickness_m: Floats  # (F,) of the slab; infinite: opaque
    start: Floats  # (E, 3) m
    end: Floats  # (E, 3) m
    faces: Ints  # (E, 2) facets that meet there; of a sheet's edge the sheet twice
    tangent: Floats  # (E, 3) unit vector in the first face, across the edge and away from it
    angle: Floats  # (E,) outer angle between the faces, in units of pi: 1.5 at a box, 2 at a sheet
    side_first: Ints  # (V + 1,) of the sides of each body
    side: Floats  # (S, 3) x, y of the outward unit normal, and ``normal . point`` m
    bottom: Floats  # (V,) m
    top: Floats  # (V,) m
    body_solid: Ints  # (V,) of which solid
    stops: NDArray[np.bool_]  # (V,) whether nothing passes through it
