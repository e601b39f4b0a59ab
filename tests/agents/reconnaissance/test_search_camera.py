"""Searching with a camera: which pictures count as looks, and lanes as wide as they show."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.agents.search_agents import GRID, info, see
from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.search import Search
from vcmvsp.agents.reconnaissance.sectors import lanes
from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.types import Image, Sighting, Velocity

S = 1_000_000_000
PIXELS = (48, 64)
PICTURE = Image(pixels=np.zeros((*PIXELS, 3), np.uint8), focal_px=40.0)


class Eye:
    """Stands for a `Watch`: shows what the test says."""

    def __init__(self) -> None:
        self.next: WatchFrame | None = None

    def look(self, obs: Observation) -> WatchFrame | None:
        return self.next


class Flight:
    """A searcher at one place, with pictures at 5 Hz; the sensor sees 12 m to all sides from 20 m."""

    def __init__(self, **params: Any) -> None:
        self.agent, self.eye, self.radio = Search((0.0, 0.0, 40.0, 40.0), **params), Eye(), Radio("a", ("a",))
        self.agent.watch = self.eye  # type: ignore[assignment]
        self.agent.start(info("a", ("a",), ("camera",)))
        self.tick = -1

    def act(self, *places: tuple[float, float], picture: bool = True, z: float = 20.0, **change: Any) -> Velocity:
        self.tick += 1
        now_ns = self.tick * S // 5
        found = tuple(Sighting(target="x", place=at, centre_px=(1.0, 1.0), angle=0.0, side_px=4.0, score=1.0) for at in places)
        nadir = Nadir((20.0, 20.0, z), (1.0, 0.0, 0.0, 0.0), 40.0, PIXELS[1], PIXELS[0])
        frame = WatchFrame(now_ns, nadir, found, PICTURE, (0, 0, PIXELS[1], PIXELS[0]), True)
        self.eye.next = replace(frame, **change) if picture else None
        return self.agent.act(see((20.0, 20.0, z), now_ns), self.radio)

    @property
    def looks(self) -> int:
        counts: int = self.agent.map._mind.counts.sum(axis=(0, 1)).max()  # type: ignore[attr-defined]
        return counts


def test_pictures_count_once_a_second() -> None:
    flight = Flight(look_s=1.0)
    for _ in range(26):
        flight.act((11.0, 9.0))
    assert flight.looks == 6
    likely, place = flight.agent.map.surest([])
    assert likely == pytest.approx(9**6 / (1 + 9**6))
    assert place == (11.0, 9.0)
    every = Flight(look_s=0.0)
    for _ in range(26):
        every.act()
    assert every.looks == 26


def test_parts_of_pictures_and_tilted_ones_do_not_count() -> None:
    flight = Flight(look_s=0.0)
    flight.act(whole=False)
    flight.act(looked=None)
    flight.act(picture=False)
    assert flight.looks == 0
    flight.act()
    assert flight.looks == 1
    seldom = Flight(look_s=1.0)
    seldom.act(looked=None)
    seldom.act()
    assert seldom.looks == 1


def test_a_picture_counts_once_however_often_it_is_asked_about() -> None:
    flight = Flight(look_s=0.0)
    flight.act()
    obs = see((20.0, 20.0, 20.0), 0)
    flight.agent.facts(obs)
    flight.agent.stand_by(obs, flight.radio)
    assert flight.looks == 1


def test_it_hovers_until_it_knows_how_far_it_sees() -> None:
    flight = Flight()
    assert flight.act(picture=False).linear[:2] == (0.0, 0.0)
    assert flight.agent.goal is None
    assert flight.act().linear[:2] != (0.0, 0.0)
    assert flight.agent.goal in lanes(GRID.area, 12.0)


def test_what_it_sees_on_the_ground_is_scaled_to_the_height_of_the_search() -> None:
    """12 m to all sides from 20 m are 6 m from 10 m."""
    flight = Flight(height=10.0)
    flight.act(z=20.0)
    flight.act(z=10.0)
    assert flight.agent.goal in lanes(GRID.area, 6.0)
    assert Flight(swath_m=7.0).act(picture=False).linear[:2] != (0.0, 0.0)


def test_a_target_outside_the_area_is_no_hit() -> None:
    flight = Flight()
    for _ in range(26):
        flight.act((-1.0, 20.0), (41.0, 20.0))
    assert flight.agent.map.blobs == []
