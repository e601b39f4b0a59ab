"""A camera that goes along with a vehicle, for everyone who looks."""

from dataclasses import dataclass

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.page.style import Every

PERIOD_S = 0.06
NEAR_M, FAR_M = 2.0, 12.0  # between which the camera begins
HAND_S = 0.4  # after a hand has left the camera, it goes along again
SETTLES_S = 0.5  # until a page says where its camera is by now
TURNED = 0.02  # of the distance: a hand was on it
LEAST_M = 0.005  # a vehicle that goes less far takes no camera along


@dataclass
class _Page:
    """The camera of a page: where it is as seen from the vehicle, m, and when it may be looked at and moved, s."""

    offset: Array
    looked_at_s: float
    moved_s: float


class Follower:
    """Keeps each page's camera where it is as seen from the vehicle, except where a hand turns it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._pages: dict[int, _Page] = {}
        self._often = Every(PERIOD_S)

    def draw(self, place: Array, now_s: float) -> None:
        """Go along with a vehicle that is here, m."""
        if not np.isfinite(place).all() or not self._often.due(now_s):
            return
        clients = self._server.get_clients()
        self._pages = {number: page for number, page in self._pages.items() if number in clients}
        for number, client in clients.items():
            offset = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            page = self._pages.get(number)
            if page is None:
                distance = max(float(np.linalg.norm(offset)), LEAST_M)
                offset = offset * (min(max(distance, NEAR_M), FAR_M) / distance)
                page = self._pages[number] = _Page(offset, looked_at_s=now_s + SETTLES_S, moved_s=now_s)
            elif now_s >= page.looked_at_s and np.linalg.norm(offset - page.offset) > TURNED * np.linalg.norm(page.offset):
                page.offset, page.moved_s = offset, now_s + HAND_S
            if now_s >= page.moved_s and np.linalg.norm(place - np.asarray(client.camera.look_at)) > LEAST_M:
                with client.atomic():
                    client.camera.position = place + page.offset
                    client.camera.look_at = place

    def release(self) -> None:
        """Let all cameras be."""
        self._pages.clear()
