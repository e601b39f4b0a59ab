"""Arrays of the compiled search: the world, and arguments, working space and results."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Floats, Ints

Complex = NDArray[np.complex128]
Flags = NDArray[np.uint8]


class Terrain(NamedTuple):
    """The world: see `netsim.propagation.rays.world`. Lengths in m; F facets with K corners, E edges, V bodies with S sides."""

    facet_first: Ints  # (F + 1,)
    corner_x: Floats  # (K,)
    corner_y: Floats
    corner_z: Floats
    cut_x: Floats  # (K,) in the plane of the facet, inwards: a point is in the facet if ``cut . point >= cut_at``
    cut_y: Floats
    cut_z: Floats
    cut_at: Floats
    normal_x: Floats  # (F,)
    normal_y: Floats
    normal_z: Floats
    plane_at: Floats
    both_sides: Ints  # (F,) 1: reflects on both sides
    passage: Ints  # (F,)
    eta_real: Floats  # (F,) relative permittivity
    eta_imag: Floats
    turns: Floats  # (F,) thickness in wavelengths; infinite: a half-space
    averaged: int  # 1: the powers of the echoes inside a slab are added, not their waves
    wave_m: float  # wavelength
    faddeeva: Floats  # (N,) see `netsim.propagation.rays.coefficients.faddeeva_numbers`
    start_x: Floats  # (E,)
    start_y: Floats
    start_z: Floats
    along_x: Floats  # (E,) unit vector
    along_y: Floats
    along_z: Floats
    length: Floats
    tangent_x: Floats  # (E,) see `Surfaces.tangent`
    tangent_y: Floats
    tangent_z: Floats
    angle: Floats  # (E,) outer, in units of pi
    first_face: Ints  # (E,)
    second_face: Ints
    group_x: Floats  # (G,) spheres round `search.GROUP` edges each, one after another
    group_y: Floats
    group_z: Floats
    group_radius: Floats
    side_first: Ints  # (V + 1,)
    side_x: Floats  # (S,)
    side_y: Floats
    side_at: Floats
    bottom: Floats  # (V,)
    top: Floats
    cell_first: Ints  # (columns * rows + 1,)
    cell_item: Ints  # bodies, and facets as ``-1 - facet``
    columns: int
    rows: int
    west: float
    south: float
    cell_m: float


class Work(NamedTuple):
    """Arguments, working space and results of a search."""

    reflections: int
    diffraction: int
    transmission: int
    counts: Ints  # see `NEXT`
    site_x: Floats  # (N,) m, the points
    site_y: Floats
    site_z: Floats
    site_cell: Ints  # (N,) the cell of each
    a: Ints  # (P,) site of one end of each pair
    b: Ints  # (P,) of the other
    view_first: Ints  # (C + 1,) what each cell may see: facets, and edges numbered behind all facets
    view_target: Ints
    site_facet_first: Ints  # (N + 1,) what each site may see
    site_facet: Ints
    site_edge_first: Ints
    site_edge: Ints
    partner_first: Ints  # (N + 1,) the other sites of the pairs of each site
    partner: Ints
    beam_first: Ints  # (facets of all sites + 1,) edges in the beam that each site has over each facet that it may see
    beam_edge: Ints
    beam_at: Floats  # m, foot of the image on each edge of a beam, and distance from it
    beam_apart: Floats
    edge_mark: Ints  # (E,) see `search.mark_edges`
    group_mark: Ints  # (G,) the same of its edges
    edge_at: Floats  # (E,) m, foot of the site on each edge that it may see, and distance from it
    edge_apart: Floats
    sees_row: int  # length of a row of ``sees``; 0: all facets have the same
    sees: Flags  # (F * (F + E),) whether each facet may see each facet and edge: see `UNKNOWN`
    facet_mark: Ints  # (F,)
    facet_leg: Ints  # (F,) the last leg that was tested against it
    body_leg: Ints  # (V,)
    cell: Ints  # (6,) of the walk over the grid
    share: Floats  # (5,)
    end_x: Floats  # (2,) ends of the path under test
    end_y: Floats
    end_z: Floats
    beam_x: Floats  # see `search.bound`
    beam_y: Floats
    beam_z: Floats
    chosen: Ints  # facets of the sequence under test
    element: Ints  # facets and edges of the path under test
    wave: Floats  # (3,) of the path under test: see `path_real`
    place: Ints
    image_x: Floats
    image_y: Floats
    image_z: Floats
    point_x: Floats
    point_y: Floats
    point_z: Floats
    region_x: Floats  # corners of what looks
    region_y: Floats
    region_z: Floats
    target_x: Floats  # corners of what is looked at
    target_y: Floats
    target_z: Floats
    hider: Ints  # (F + E,) the body that hid each target last
    seen: Ints  # (F + E,) what the region may see
    path_pair: Ints  # (n,)
    path_count: Ints  # number of interactions
    path_element: Ints  # (n * most,) facets, and edges as ``-1 - edge``
    path_x: Floats  # (n * most,)
    path_y: Floats
    path_z: Floats
    path_real: Floats  # (n,) of the gain
    path_imag: Floats
    path_length: Floats  # m
    pass_path: Ints  # (m,)
    pass_leg: Ints
    pass_facet: Ints
    pass_at: Floats  # share of the leg
