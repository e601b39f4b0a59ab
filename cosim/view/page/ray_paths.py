"""Paths of the radio wave in the browser, between the chosen vehicle and another one, where the channel traces rays."""

import json
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from vcmvsp.cosim.analysis.coverage import site_of
from vcmvsp.cosim.assembly.parts.channel_trial import ray_paths
from vcmvsp.cosim.config.registry import NO_CODE, only
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.controls import picked
from vcmvsp.cosim.view.page.drawing import Segments, rssi_colors
from vcmvsp.cosim.view.page.panel import paths_page
from vcmvsp.cosim.view.page.state import PageState

NOBODY = "nobody"
MOST, LEGS = 40, 6  # drawn paths of a link, and the greatest number of straight pieces of each
LISTED = 6  # paths in words


class Found(NamedTuple):
    """The paths of a link, the strongest first."""

    corners: Sequence[Array]  # of each path (k, 3) m, with both antennas
    level_dbm: Array  # (n,) between isotropic antennas
    kinds: Sequence[str]


class RayPaths:
    """Lines along the paths, in the colours of links, and the strongest ones in words; traced in a thread of their own.

    Create it in the context of its container.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._site, self._names = scenery.site, [each.name for each in scenery.vehicles]
        self._lines = Segments(server, "/paths", np.zeros((MOST * LEGS if self._site else 0, 2, 3), np.uint8), 2.0)
        self._link: tuple[str, str, Array] | None = None  # names and places, (2, 3) m
        self._request, self._traced = threading.Event(), Found((), np.zeros(0), ())
        self._drawn_paths: Found | None = None
        if not self._site:
            return
        self._to = server.gui.add_dropdown("Paths to", [NOBODY, *self._names])
        self._words = server.gui.add_html("")
        threading.Thread(target=self._trace, name="paths", daemon=True).start()

    def draw(self, state: PageState, chosen: int) -> None:
        """Draw what has been traced, and ask for the paths at the present places."""
        if not self._site:
            return
        if self._traced is not self._drawn_paths:
            self._drawn_paths = self._traced
            points, colors = segments(self._drawn_paths)
            self._lines.put(points, colors)
            self._words.content = in_words(self._drawn_paths)
        receiver = picked(self._to)
        link = None
        if receiver not in (NOBODY, self._names[chosen]):
            places = state.position[[chosen, self._names.index(receiver)]]
            link = (self._names[chosen], receiver, places) if np.isfinite(places).all() else None
        if repr(link) != repr(self._link):
            self._link = link
            self._request.set()

    def _trace(self) -> None:
        """Trace the link that is wanted, whenever another one is."""
        site = None
        while self._request.wait():
            self._request.clear()
            link = self._link
            try:
                if site is None:
                    with only(NO_CODE):
                        _, _, site = site_of(json.loads(self._site), settings=None, seed=None, trust=False)
                self._traced = Found((), np.zeros(0), ()) if link is None else _link_paths(site.channel, *link)
            except VcmvspError:  # an antenna inside a solid, or a world of a class that is not imported here
                self._traced = Found((), np.zeros(0), ())


def _link_paths(channel: Any, sender: str, receiver: str, places: Array) -> Found:
    antennas = places + channel.budgets.antennas_above((sender, receiver))
    rows = ray_paths(channel, antennas).to_pylist()
    rows.sort(key=lambda row: -row["gain_db"])
    corners = [np.array([antennas[0], *_turns(row), antennas[1]]) for row in rows]
    level_dbm = channel.phy.tx_power_dbm + np.array([row["gain_db"] for row in rows], float)
    return Found(corners, level_dbm, [row["kinds"] for row in rows])


def _turns(row: dict[str, Any]) -> list[list[float]]:
    """Where a path changes its direction, m."""
    steps = zip(row["kinds"].split("+"), row["points"], strict=False)  # a direct path has no points
    return [point for kind, point in steps if kind != "transmission"]


def segments(paths: Found) -> tuple[Array, Array]:
    """Ends (m) and colours of the pieces of all drawn paths, (`MOST` x `LEGS`, 2, 3) each."""
    points, colors = np.zeros((MOST, LEGS, 2, 3)), np.zeros((MOST, LEGS, 2, 3), np.uint8)
    for path, corners in enumerate(paths.corners[:MOST]):
        legs = np.stack([corners[:-1], corners[1:]], axis=1)[:LEGS]
        points[path, : len(legs)] = legs
    count = len(paths.corners[:MOST])
    colors[:count] = rssi_colors(paths.level_dbm[:count])[:, None, None]
    return points.reshape(-1, 2, 3), colors.reshape(-1, 2, 3)


def in_words(paths: Found) -> str:
    """The strongest paths, as HTML."""
    if not paths.kinds:
        return ""
    rows = [(f"{level:.1f} dBm", kinds) for level, kinds in zip(paths.level_dbm[:LISTED], paths.kinds, strict=False)]
    return paths_page([*rows, ("", f"{len(paths.kinds)} paths")])
