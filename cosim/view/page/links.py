"""The radio in the browser: half a line from each sender towards each receiver that its newest frame was meant for.

The half that begins at a vehicle is what it sent, so that a link that works in one direction only is seen to.
"""

import numpy as np
import viser

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.batches import Segments
from vcmvsp.cosim.view.page.state import Known
from vcmvsp.cosim.view.page.style import LOST_RGB, STRONGEST_DBM, WEAKEST_DBM, rssi_colors

FRESH_NS = SECOND_NS  # how long a frame is shown
MOST = 600  # half lines; of more, the newest are drawn
BLINK_S = 0.25
FEW = 12  # vehicles of which all links are drawn at first
WHICH = ALL, OWN, NONE = "all", "of the chosen vehicle", "none"


class Links:
    """The links that had a frame in the last second: coloured by received power, blinking red where it was lost."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        count = len(scenery.vehicles)
        self._room = min(count * (count - 1), MOST)
        self._lines = Segments(server, "/links", np.zeros((self._room, 2, 3), np.uint8), 2.5)
        self._up = np.array([(0.0, 0.0, each.offset[2] + 0.5 * each.size[2]) for each in scenery.vehicles]).reshape(-1, 3)
        self.which = ALL if count <= FEW else OWN

    def draw(self, known: Known, chosen: int, now_s: float) -> None:
        """Draw those that are fresh now."""
        if not self._room:
            return
        of = {ALL: None, OWN: chosen, NONE: -1}[self.which]
        sender, receiver = fresh_links(known, self._room, of)
        tops = known.position + self._up  # else they would run through the bodies
        here, there = tops[sender], tops[receiver]
        points = np.zeros((self._room, 2, 3))
        colors = np.zeros((self._room, 2, 3), np.uint8)
        got = known.link_received[sender, receiver]
        shade = np.where(got[:, None], rssi_colors(known.link_rssi_dbm[sender, receiver]), np.array(LOST_RGB, np.uint8))
        blinks = ~got & bool(int(now_s / BLINK_S) % 2)  # away every other moment
        points[: len(sender), 0] = here
        points[: len(sender), 1] = np.where(blinks[:, None], here, 0.5 * (here + there))
        colors[: len(sender)] = shade[:, None]
        self._lines.put(points, colors)


def fresh_links(known: Known, most: int, of: int | None = None) -> tuple[Array, Array]:
    """Rows of senders and receivers with a frame in the last second, the newest if there are too many; in steady order.

    Args:
        known: so far.
        most: how many there may be.
        of: the row of a vehicle, for its own alone; None: of all.
    """
    age = known.time_ns - known.link_sent_ns
    placed = np.isfinite(known.position).all(axis=1)
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
    """What the colours mean, as HTML."""
    stops = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in rssi_colors(np.linspace(WEAKEST_DBM, STRONGEST_DBM, 6)).tolist())
    red = "rgb({}, {}, {})".format(*LOST_RGB)
    bar = f"height: 0.6em; margin: 0.2em 0; background: linear-gradient(90deg, {stops})"
    return (
        f'<div style="padding: 0 0.75em 0.5em; font-size: 0.8em">Links: received power<div style="{bar}"></div>'
        f'<div style="display: flex; justify-content: space-between"><span>{WEAKEST_DBM:.0f} dBm</span>'
        f'<span style="color: {red}">blinking: lost</span><span>{STRONGEST_DBM:.0f} dBm</span></div></div>'
    )
