"""The colour of each triangle of a world's mesh, for whoever draws the mesh as it is."""

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import color_of
from vcmvsp.physics.world.world import World


def mesh_colors(world: World) -> Array:
    """Red, green and blue of the triangles of ``world.mesh()``, in their order: (t, 3) uint8, without light."""
    prisms = [np.repeat(group.solid, 4 * group.corners.shape[1] - 4) for group in world.shapes.groups]  # sides, top, bottom
    solid = np.concatenate([*prisms, world.shapes.triangle_solid])
    colors: Array = np.array([color_of(each) for each in world.solids], np.uint8).reshape(-1, 3)[solid]
    return colors
