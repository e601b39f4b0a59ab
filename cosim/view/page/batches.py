"""Nodes of the scene that draw many things at once, so that a hundred vehicles cost the browser as few messages as three."""

from collections.abc import Callable

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.page.style import TINY, Mesh, linear


class Batch:
    """One shape, drawn ``count`` times in colours of their own; nothing at all for a count of 0.

    Args:
        server: of the page.
        name: of the node.
        mesh: the shape.
        colors: (count, 3) uint8.
        opacity: of all; None: opaque.
        clicked: called with the number of the one that is clicked at.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        mesh: Mesh,
        colors: Array,
        *,
        opacity: float | None = None,
        clicked: Callable[[int], None] | None = None,
    ) -> None:
        count = len(colors)
        self._handle: viser.BatchedMeshHandle | None = None
        if not count:
            return
        vertices, faces = mesh
        self._handle = handle = server.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            batched_wxyzs=np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
            batched_positions=np.zeros((count, 3)),
            batched_scales=np.full((count, 3), TINY),
            batched_colors=linear(colors),
            opacity=opacity,
            flat_shading=True,
            lod="off",
            cast_shadow=False,
        )
        if clicked is not None:
            take = clicked

            @handle.on_click
            def _(event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
                if event.instance_index is not None:
                    take(event.instance_index)

    def put(self, position: Array, wxyz: Array, scale: Array) -> None:
        """Where each is, (count, 3) m, how it is turned, (count, 4), and its size, (count, 3); `TINY`: it is not seen."""
        if self._handle is not None:
            self._handle.batched_positions = position
            self._handle.batched_wxyzs = wxyz
            self._handle.batched_scales = scale

    def show(self, visible: bool) -> None:
        """Let all be seen, or none."""
        if self._handle is not None:
            self._handle.visible = visible


class Segments:
    """So many straight lines; those that are not wanted begin and end at the same place.

    Args:
        server: of the page.
        name: of the node.
        colors: of both ends, (count, 2, 3) uint8.
        width_px: of the lines.
    """

    def __init__(self, server: viser.ViserServer, name: str, colors: Array, width_px: float) -> None:
        self._handle: viser.LineSegmentsHandle | None = None
        if len(colors):
            self._handle = server.scene.add_line_segments(
                name, np.zeros((len(colors), 2, 3)), linear(colors), thickness=width_px, thickness_units="screen"
            )

    def put(self, points: Array, colors: Array | None = None) -> None:
        """Where each begins and ends, (count, 2, 3) m, and its colours if they are other ones."""
        if self._handle is not None:
            self._handle.points = points
            if colors is not None:
                self._handle.colors = linear(colors)

    def show(self, visible: bool) -> None:
        """Let all be seen, or none."""
        if self._handle is not None:
            self._handle.visible = visible
