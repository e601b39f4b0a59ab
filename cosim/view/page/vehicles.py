"""The vehicles in the browser: bodies, names, trails, slots of followers, and links."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import viser

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.drawing import (
    CHOSEN_RGB,
    EDGE_RGB,
    LOST_RGB,
    STOPPED_RGB,
    STRONGEST_DBM,
    TINY,
    WEAKEST_DBM,
    WHITE,
    Batch,
    Every,
    Segments,
    colors_of,
    disc,
    nose,
    pixel_m,
    quadrotor,
    ring,
    robot,
    rotated,
    rssi_colors,
    wheel,
)
from vcmvsp.cosim.view.page.state import PageState

LABELS = 200  # vehicles with a name beside them
NAMED = 24  # up to this many vehicles, names are shown at first
LABELS_AT_ONCE = 16  # labels moved per update: each costs a message
ABOVE_M = 0.12  # height of a name over its body
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
SLOT = 0.55  # radius of the mark of a slot, of the diagonal of the body
LEADER_RGB = (120, 126, 134)  # of lines from followers to their leaders
DOT_PX = 13.0  # across, of the dot in the middle of each vehicle: hides in the body where that appears larger
DOT_M = 0.005  # half the length of the segment that it is drawn as
WHEEL = 0.42  # largest diameter of a wheel, of the length of the body
SEGMENTS, LONGEST, SHORTEST = 1200, 150, 12
"""Limit for all trails together, and for each."""
TRAIL_NS = 30 * SECOND_NS  # length of a trail; longer in very fast runs
LEAST_M = 0.03  # radius of the marker of an exact position
OVER_M = 0.02  # above the floor, for visibility
FRESH_NS = SECOND_NS  # display time of a frame
MOST = 200  # arrows; of more, the newest are drawn
BARB, MOST_BARB_M = 0.06, 1.0  # length of the barbs of an arrow, of its length, and limit
FEW = 12  # up to this many vehicles, all links are drawn at first
WHICH = ALL, OWN, NONE = "all", "of the chosen vehicle", "none"


class Places(NamedTuple):
    """Places of the k followers in their formations, at one instant."""

    row: Array  # (k,) index of each follower
    leader: Array  # (k,) index of its leader
    place: Array  # (k, 3) m, world: slot for its present heading, at its own height
    yaw: Array  # (k,) rad, its own heading
    error_m: Array  # (k,), the formation error: see `cosim.types.Follows`


def places_of(state: PageState) -> Places:
    """The present slots of followers whose positions are known."""
    rows = [
        (state.row[name], state.row[each.leader], *each.slot, each.handle_m)
        for name, each in state.now.places.items()
        if name in state.row and each.leader in state.row
    ]
    table = np.array(rows, float).reshape(-1, 5)
    row, leader = table[:, 0].astype(int), table[:, 1].astype(int)
    slot, handle = table[:, 2:4], table[:, 4]
    yaw, own = state.yaw[leader], state.yaw[row]
    ahead, own_ahead = _unit(yaw), _unit(own)
    left = ahead[:, ::-1] * (-1.0, 1.0)
    centre = state.position[leader, :2] + slot[:, :1] * ahead + slot[:, 1:] * left
    position = state.position[row]
    off = position[:, :2] + handle[:, None] * own_ahead - (centre + handle[:, None] * ahead)
    is_known = np.isfinite(off).all(axis=1)
    place = np.column_stack([position[:, :2] - off, position[:, 2]])  # on a curve the handles coincide
    return Places(*(part[is_known] for part in (row, leader, place, own, np.hypot(off[:, 0], off[:, 1]))))


def errors_of(state: PageState) -> Array:
    """Formation error of each vehicle, (n,) m; NaN: it follows no other, or a position is unknown."""
    places = places_of(state)
    error_m = np.full(len(state.names), np.nan)
    error_m[places.row] = places.error_m
    return error_m


def _unit(yaw: Array) -> Array:
    return np.column_stack([np.cos(yaw), np.sin(yaw)])


class Vehicles:
    """All vehicles of a run, drawn in a few nodes."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery, choose: Callable[[int], None]) -> None:
        crafts = scenery.vehicles
        count = len(crafts)
        self._size = np.array([each.size for each in crafts], float).reshape(-1, 3)
        self._offset = np.array([each.offset for each in crafts], float).reshape(-1, 3)
        flies = np.array([each.flies for each in crafts], bool)
        colors = colors_of(count)
        own = np.array([each.shape in scenery.shapes for each in crafts], bool)
        self._rows = np.flatnonzero(~flies & ~own), np.flatnonzero(flies & ~own)
        self._air = np.flatnonzero(flies)
        shapes = ("ground", robot()), ("air", quadrotor())
        self._bodies = [
            Batch(server, f"/vehicles/{name}", mesh, colors[rows], clicked=_clicked(rows, choose))
            for (name, mesh), rows in zip(shapes, self._rows, strict=True)
        ]
        self._own = [OwnShape(server, scenery, name, choose) for name in scenery.shapes]
        self._wheels = Wheels(server, self._size[self._rows[0]], self._offset[self._rows[0]])
        self._dots = Segments(server, "/vehicles/dots", np.repeat(colors[:, None], 2, axis=1), DOT_PX)
        self._noses = Batch(server, "/vehicles/noses", nose(), np.tile(np.array(WHITE, np.uint8), (count, 1)))
        self._stopped = Batch(server, "/stopped", disc(), np.tile(np.array(STOPPED_RGB, np.uint8), (count, 1)), opacity=0.45)
        self._drops = Segments(server, "/heights", np.repeat(colors[self._air, None], 2, axis=1), 1.0)
        vertices, faces = ring()
        self._chosen = server.scene.add_mesh_simple(
            "/chosen", vertices, faces, color=CHOSEN_RGB, side="double", visible=False, cast_shadow=False
        )
        self.labels = [
            server.scene.add_label(f"/names/{each.name}", each.name, font_screen_scale=0.8, anchor="bottom-center")
            for each in crafts[:LABELS]
        ]
        self.names_at_first = count <= NAMED
        if not self.names_at_first:
            for label in self.labels:
                label.visible = False
        self._server, self._label = server, 0
        self._slow = Every(0.1)

    def draw(self, state: PageState, chosen: int, now_s: float) -> None:
        """Update all vehicles."""
        if not len(self._size):
            return
        is_known = np.isfinite(state.position).all(axis=1)
        centre = np.where(is_known[:, None], state.position, 0.0) + rotated(state.attitude, self._offset)
        scale = np.where(is_known[:, None], self._size, TINY)
        for rows, bodies in zip(self._rows, self._bodies, strict=True):
            bodies.put(centre[rows], state.attitude[rows], scale[rows])
        for shape in self._own:
            shape.put(state.position, state.attitude, is_known)
        self._noses.put(centre, state.attitude, scale)
        ground = self._rows[0]
        self._wheels.put(state.position[ground], state.attitude[ground], is_known[ground])
        reach = np.where(is_known[:, None], DOT_M, 0.0)
        lift = np.maximum(0.5 * DOT_PX * pixel_m(self._server, centre) - 0.5 * self._size[:, 2], 0.0)  # out of the floor
        dots = centre + np.column_stack([np.zeros((len(lift), 2)), lift])
        self._dots.put(np.stack([dots - reach, dots + reach], axis=1))
        top = centre[self._air]
        self._drops.put(np.stack([top, top * (1.0, 1.0, 0.0)], axis=1))
        floor = centre - np.column_stack([np.zeros_like(scale[:, :2]), 0.5 * self._size[:, 2]])
        reach = 0.5 * np.hypot(self._size[:, 0], self._size[:, 1])
        self._chosen.visible = bool(is_known[chosen])
        self._chosen.position, self._chosen.scale = floor[chosen], 1.15 * float(reach[chosen])
        if self._slow.due(now_s):
            self._draw_stopped(state, floor, reach)
        self._draw_labels(centre)

    def _draw_stopped(self, state: PageState, floor: Array, reach: Array) -> None:
        radius = np.full(len(reach), TINY)
        rows = [state.row[name] for name in state.now.halted if name in state.row]
        radius[rows] = 1.5 * reach[rows]
        for node in self._stopped.nodes:
            node.visible = len(rows) > 0  # translucent shapes cost time even where they are tiny
        upright = np.tile(UPRIGHT, (len(reach), 1))
        self._stopped.put(floor, upright, np.column_stack([radius, radius, np.ones(len(reach))]))

    def _draw_labels(self, centre: Array) -> None:
        """Move labels; of many vehicles some at a time, in turn."""
        count = len(self.labels)
        rows = (self._label + 1 + np.arange(min(LABELS_AT_ONCE, count))) % max(count, 1)
        up = np.maximum(0.5 * self._size[rows, 2] + ABOVE_M, DOT_PX * pixel_m(self._server, centre[rows]))
        for row, height in zip(rows.tolist(), up.tolist(), strict=True):
            self._label = row
            self.labels[row].position = centre[row] + (0.0, 0.0, height)


class OwnShape:
    """Vehicles with a shape of their own, in its colours."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery, name: str, choose: Callable[[int], None]) -> None:
        self._rows = np.array([row for row, each in enumerate(scenery.vehicles) if each.shape == name], int)
        number = list(scenery.shapes).index(name)
        self._parts = [
            Batch(
                server,
                f"/vehicles/own{number}/{place}",
                (part.triangles.reshape(-1, 3), np.arange(3 * len(part.triangles), dtype=np.uint32).reshape(-1, 3)),
                np.tile(np.array(part.color, np.uint8), (len(self._rows), 1)),
                clicked=_clicked(self._rows, choose),
            )
            for place, part in enumerate(scenery.shapes[name])
        ]

    def put(self, position: Array, attitude: Array, is_known: Array) -> None:
        """Set the poses of all vehicles, (n, 3) m and (n, 4); those not seen are not drawn."""
        is_shown = is_known[self._rows, None]
        place, scale = np.where(is_shown, position[self._rows], 0.0), np.repeat(np.where(is_shown, 1.0, TINY), 3, axis=1)
        for part in self._parts:
            part.put(place, attitude[self._rows], scale)


class Wheels:
    """Two wheels of each differential-drive robot, round whatever the size of its body."""

    def __init__(self, server: viser.ViserServer, size: Array, offset: Array) -> None:
        length, width, height = size.T
        across = np.minimum(WHEEL * length, height)
        thickness = 0.13 * width
        aside = 0.5 * (width - thickness)
        self._scale = np.repeat(np.column_stack([across, thickness, across]), 2, axis=0)
        self._place = np.repeat(offset, 2, axis=0)
        self._place[:, 2] += np.repeat(0.5 * (across - height), 2)  # on the floor
        self._place[::2, 1] += aside
        self._place[1::2, 1] -= aside
        self._wheels = Batch(server, "/vehicles/wheels", wheel(), np.tile(np.array(EDGE_RGB, np.uint8), (2 * len(size), 1)))

    def put(self, position: Array, attitude: Array, is_known: Array) -> None:
        """Set the wheels of robots with these poses, (k, 3) m and (k, 4); those not seen have none."""
        turn, is_shown = np.repeat(attitude, 2, axis=0), np.repeat(is_known, 2)[:, None]
        place = np.where(is_shown, np.repeat(position, 2, axis=0), 0.0) + rotated(turn, self._place)
        self._wheels.put(place, turn, np.where(is_shown, self._scale, TINY))


def _clicked(rows: Array, choose: Callable[[int], None]) -> Callable[[int], None]:
    return lambda index: choose(int(rows[index]))


class Trails:
    """Recent tracks of the vehicles."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        count = len(scenery.vehicles)
        self._steps = min(max(SEGMENTS // max(count, 1), SHORTEST), LONGEST)
        # A slow fade to the floor's colour marks the old end.
        share = np.linspace(0.25, 1.0, self._steps + 1)[None, :, None]
        shades = (235.0 + share * (colors_of(count)[:, None] - 235.0)).astype(np.uint8)
        self._lines = Segments(server, "/trails", _pairs(shades), 2.0)
        self.nodes = self._lines.nodes
        self._places = np.empty((count, 0, 3))
        self._next_ns, self._times_back = 0, 0
        self._often = Every(0.25)
        self._new = False

    def sample(self, state: PageState) -> None:
        """Add the present positions, if due."""
        if state.times_back != self._times_back:
            self._times_back, self._next_ns = state.times_back, 0
            self._places = self._places[:, :0]
        if state.now.time_ns < self._next_ns or not np.isfinite(state.position).any():
            return
        self._next_ns = state.now.time_ns + TRAIL_NS // self._steps
        self._places = np.concatenate([self._places[:, -self._steps :], state.position[:, None]], axis=1)
        self._new = True

    def draw(self, now_s: float) -> None:
        """Draw the trails if they have grown."""
        if self._new and self._often.due(now_s):
            self._new = False
            missing = self._steps + 1 - self._places.shape[1]
            padded = np.concatenate([np.repeat(self._places[:, :1], missing, axis=1), self._places], axis=1)
            pairs = _pairs(padded)
            unknown = ~np.isfinite(pairs).all(axis=(1, 2))
            pairs[unknown] = 0.0
            self._lines.put(pairs)


class Ghosts:
    """The formation: an open mark at the slot of each follower, a line to it, and a line from the follower to its leader."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        size = np.array([each.size for each in scenery.vehicles], float).reshape(-1, 3)
        offset = np.array([each.offset for each in scenery.vehicles], float).reshape(-1, 3)
        self._down, self._reach = 0.5 * size[:, 2] - offset[:, 2], SLOT * np.hypot(size[:, 0], size[:, 1])
        colors = colors_of(len(size))
        self._marks = Batch(server, "/places/marks", ring(width=0.3), colors)
        self._lines = Segments(server, "/places/lines", np.repeat(colors[:, None], 2, axis=1), 1.5)
        grey = np.tile(np.array(LEADER_RGB, np.uint8), (len(size), 2, 1))
        self._leaders = Segments(server, "/places/leaders", grey, 2.0)
        self.nodes = [*self._marks.nodes, *self._lines.nodes, *self._leaders.nodes]

    def draw(self, state: PageState) -> None:
        """Update the slots."""
        places, count = places_of(state), len(self._reach)
        position, scale = np.zeros((count, 3)), np.full((count, 3), TINY)
        lines, leaders = np.zeros((count, 2, 3)), np.zeros((count, 2, 3))
        followers = state.position[places.row]
        position[places.row] = places.place - np.column_stack([np.zeros((len(followers), 2)), self._down[places.row]])
        scale[places.row] = self._reach[places.row, None] * (1.0, 1.0, 0.0) + (0.0, 0.0, 1.0)
        lines[places.row] = np.stack([followers, places.place], axis=1)
        leaders[places.row] = np.stack([followers, state.position[places.leader]], axis=1)
        self._marks.put(position, np.tile(UPRIGHT, (count, 1)), scale)
        self._lines.put(lines)
        self._leaders.put(leaders)


class Fixes:
    """Position fixes of vehicles: a disc with a radius of one standard deviation for each."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        colors = colors_of(len(scenery.vehicles))
        self._discs = Batch(server, "/fixes", disc(), colors, opacity=0.35)
        self.nodes = self._discs.nodes
        self._flies = [each.flies for each in scenery.vehicles]
        self._often, self._any = Every(0.1), False

    def draw(self, state: PageState, now_s: float) -> None:
        """Update the fixes."""
        if not (state.now.fixes or self._any) or not self._often.due(now_s):
            return
        self._any = bool(state.now.fixes)
        count = len(state.names)
        position, scale = np.zeros((count, 3)), np.full((count, 3), TINY)
        for name, fix in state.now.fixes.items():
            if (row := state.row.get(name)) is not None:
                position[row] = fix.position
                if not self._flies[row]:  # on the floor, for any measured height
                    position[row, 2] = state.position[row, 2] + OVER_M
                scale[row] = (max(fix.sigma_m, LEAST_M), max(fix.sigma_m, LEAST_M), 1.0)
        self._discs.put(position, np.tile(UPRIGHT, (count, 1)), scale)


def _pairs(points: Array) -> Array:
    """Split chains of points, (n, k + 1, 3), into segments, (n * k, 2, 3)."""
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


class Links:
    """Links with a frame in the last second: arrows from sender to receiver, coloured by power, or red where lost."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        count = len(scenery.vehicles)
        self._room = min(count * (count - 1), MOST)
        self._lines = Segments(server, "/links", np.zeros((3 * self._room, 2, 3), np.uint8), 2.5 if count <= FEW else 1.5)
        self._up = np.array([(0.0, 0.0, each.offset[2] + 0.5 * each.size[2]) for each in scenery.vehicles]).reshape(-1, 3)
        self.which = ALL if count <= FEW else OWN

    def draw(self, state: PageState, chosen: int) -> None:
        """Draw the links with fresh frames."""
        if not self._room:
            return
        of = {ALL: None, OWN: chosen, NONE: -1}[self.which]
        sender, receiver = fresh_links(state, self._room, of)
        tops = state.position + self._up  # avoids lines through the bodies
        points = np.zeros((self._room, 3, 2, 3))
        colors = np.zeros((self._room, 3, 2, 3), np.uint8)
        is_received = state.link_received[sender, receiver]
        shade = np.where(is_received[:, None], rssi_colors(state.link_rssi_dbm[sender, receiver]), np.array(LOST_RGB, np.uint8))
        points[: len(sender)] = arrows(tops[sender], tops[receiver])
        colors[: len(sender)] = shade[:, None, None]
        self._lines.put(points.reshape(-1, 2, 3), colors.reshape(-1, 2, 3))


def arrows(begin: Array, end: Array) -> Array:
    """Shaft and two barbs of arrows between places, (k, 3) m: (k, 3, 2, 3) m.

    An arrow lies to the right of the straight line, so that the two of a pair do not cover each other.
    """
    along = end - begin
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), TINY)
    ahead = along / length
    right = np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(along))])
    barb = np.minimum(BARB * length, MOST_BARB_M)
    aside = 0.25 * barb * right
    first, last = begin + 0.06 * along + aside, end - 0.06 * along + aside
    ends = [last - barb * ahead + side * 0.5 * barb * right for side in (-1.0, 1.0)]
    return np.stack([np.stack([start, last], axis=1) for start in (first, *ends)], axis=1)


def fresh_links(state: PageState, most: int, of: int | None = None) -> tuple[Array, Array]:
    """Senders and receivers (rows) with a frame in the last second, newest ``most``, in steady order; ``of``: a vehicle."""
    age = state.now.time_ns - state.link_sent_ns
    placed = np.isfinite(state.position).all(axis=1)
    fresh = (age >= 0) & (age <= FRESH_NS) & placed[:, None] & placed[None, :]
    sender, receiver = np.nonzero(fresh)
    if of is not None:
        own = (sender == of) | (receiver == of)
        sender, receiver = sender[own], receiver[own]
    if len(sender) > most:
        newest = np.sort(np.argsort(age[sender, receiver], kind="stable")[:most])
        sender, receiver = sender[newest], receiver[newest]
    return sender, receiver


def legend() -> str:
    """Legend of the links, the formation and the chosen vehicle, as HTML."""
    stops = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in rssi_colors(np.linspace(WEAKEST_DBM, STRONGEST_DBM, 6)).tolist())
    red, orange, grey = ("rgb({}, {}, {})".format(*color) for color in (LOST_RGB, CHOSEN_RGB, LEADER_RGB))
    bar = f"height: 0.5em; margin: 0.2em 0; background: linear-gradient(90deg, {stops})"
    return (
        f'<div style="padding: 0.3em 0.75em; font-size: 0.8em">Frames, sender &rarr; receiver: '
        f'<b style="color: {red}">&rarr; lost</b>, or received at<div style="{bar}"></div>'
        f'<div style="display: flex; justify-content: space-between"><span>{WEAKEST_DBM:.0f} dBm</span>'
        f"<span>{STRONGEST_DBM:.0f} dBm</span></div>"
        f'<b>&#9711;</b> slot of a follower, <b style="color: {grey}">&#8212;</b> to its leader<br>'
        f'<b style="color: {orange}">&#9711;</b> chosen vehicle</div>'
    )
