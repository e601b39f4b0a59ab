"""Search as an agent: final maps of a team, messages, and division of the area."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support.agents import agent_loop
from tests.support.agents.agent_loop import reception_of
from tests.support.agents.search_agents import GRID, REACH, TARGETS, Team, info, looks, observation, of_map, searcher
from vcmvsp.agents.reconnaissance.exchange import Ledger
from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.roster import Claim, Roster
from vcmvsp.agents.reconnaissance.search import Search
from vcmvsp.agents.reconnaissance.sectors import lanes, strips
from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.agent import Body, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.testing import check_agent
from vcmvsp.cosim.types import Image, Message, ProbabilityMap, Scan, Sighting, Velocity

S = 1_000_000_000


def counts(agent: Search) -> np.ndarray:
    mind = agent.map._mind
    assert isinstance(mind, Ledger)
    return mind.counts


@pytest.mark.parametrize("loss", [0.0, 0.7])
def test_a_team_finds_and_notes_all_targets(loss: float) -> None:
    rng = np.random.default_rng(1)
    team = Team({name: searcher(targets=2, alive_s=30.0) for name in ("a", "b")}, lost=lambda *_: rng.random() < loss)
    team.run(60.0)
    for name, notes in team.notes.items():
        found = [(note["found_x"], note["found_y"]) for note in notes if "found" in note]
        for target in TARGETS:
            assert min(math.dist(target, place) for place in found) < 2.0, name
        done = [i for i, note in enumerate(notes) if note.get("status") == "done"]
        assert [i for i, note in enumerate(notes) if "found" in note][1:2] == done
        assert all(math.dist(a, b) > 3.0 for i, a in enumerate(found) for b in found[:i])


def test_each_member_searches_its_whole_strip() -> None:
    team, area = Team({name: searcher() for name in ("a", "b")}), GRID.area
    for _ in range(320):  # 115 m at 4 m/s, plus turns
        team.step()
        for name, agent in team.agents.items():
            assert agent.goal in lanes(strips(area, ("a", "b"))[name], REACH, 0.2)
    for name, agent in team.agents.items():
        strip, x = strips(area, ("a", "b"))[name], GRID.centres(np.arange(400))[:, 0]
        own_cells = (x > strip.left) & (x < strip.right)
        assert agent.map.for_recording().seen.ravel()[own_cells].mean() > 0.97


def test_the_strip_of_a_silent_member_is_divided_until_it_returns() -> None:
    team = Team({name: searcher(alive_s=3.0) for name in ("a", "b")})
    own_points, all_of_it = (set(lanes(strips(GRID.area, names)["a"], REACH, 0.2)) for names in (("a", "b"), ("a",)))
    ends = {(x, y) for x, _ in all_of_it for y in (3.0, 37.0)}
    team.run(5.0)
    before = team.agents["a"].goal
    team.run(2.0, dead=("b",))  # last received at 4.1 s
    assert team.agents["a"].goal in own_points
    team.run(0.3, dead=("b",))
    assert team.agents["a"].goal in ends - own_points
    team.run(1.0)
    assert team.agents["a"].goal in own_points
    assert before in own_points


def test_in_stand_by_it_looks_and_shares_and_then_resumes_its_lane() -> None:
    team = Team({name: searcher() for name in ("a", "b")})
    team.run(6.0)
    sent, look_count, goal = len(of_map(team.sent["a"])), counts(team.agents["b"])[0].sum(), team.agents["a"].goal
    team.run(8.0, standing_by=("a",))
    assert team.agents["a"].goal is None
    assert len(of_map(team.sent["a"])) >= sent + 8
    assert counts(team.agents["b"])[0].sum() > look_count
    team.step()
    assert team.agents["a"].goal == goal


def test_a_climb_does_not_count_as_stuck() -> None:
    """No way-point is dropped during a vertical climb."""
    team = Team({"a": searcher(stuck_s=3.0)})
    team.run(3.0)
    goal, (x, y, _) = team.agents["a"].goal, team.places["a"]
    for _ in range(50):
        team.places["a"] = x, y, 12.0
        team.step()
    team.places["a"] = x, y, 20.0
    team.step()
    assert team.agents["a"].goal == goal is not None


def test_a_second_start_repeats_the_first_run() -> None:
    agents, runs = {name: searcher() for name in ("a", "b")}, []
    for _ in range(2):
        team = Team(agents)
        team.run(12.0, dead=())
        team.run(8.0, dead=("b",))
        runs.append((team.sent, team.notes, team.places))
    assert runs[0] == runs[1]


def test_messages_are_limited_and_counted() -> None:
    team = Team({name: searcher(max_bytes=300, most=2, share_s=0.5) for name in ("a", "b")})
    team.run(12.0)
    for name in team.agents:
        messages = of_map(team.sent[name])
        assert max(each.size_bytes for each in messages) <= 300
        assert 24 <= len(messages) <= 2 * 24
        noted = [note["map_bytes"] for note in team.notes[name] if "map_bytes" in note]
        assert noted == sorted(set(noted))
        assert noted[-1] == sum(each.size_bytes for each in messages)


@pytest.mark.parametrize("exchange", ["none", "delta", "consensus"])
def test_maps_agree_with_every_exchange_except_none(exchange: Any) -> None:
    team = Team({name: searcher(exchange=exchange, scaled=True, most=100) for name in ("a", "b")})
    team.run(40.0)
    a, b = (agent.map.odds for agent in team.agents.values())
    message_counts = [len(of_map(messages)) for messages in team.sent.values()]
    if exchange == "none":
        assert message_counts == [0, 0]
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] < 0.5
    else:
        assert min(message_counts) >= 30
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.9


def test_a_consensus_continues_without_looks() -> None:
    """Two members with one exchange move to their mean within a step: l <- (1 - 1/2) l + l'/2."""
    agents = {name: searcher(exchange="consensus", most=100) for name in ("a", "b")}
    radios = {name: Radio(name, ("a", "b")) for name in agents}
    air: list[Message] = []
    for name, agent in agents.items():
        agent.start(info(name, ("a", "b")))
    for tick in range(31):
        sent: list[Message] = []
        for i, (name, agent) in enumerate(agents.items()):
            receptions = [reception_of(each) for each in air if each.sender != name]
            readings: dict[str, Any] = {"looks": looks(10.0 + 10.0 * i, 20.0, 0)} if tick == 0 else {}
            agent.act(observation((20.0, 20.0, 20.0), tick * S // 10, *receptions, **readings), radios[name])
            sent += radios[name].drain()
        air = sent
    a, b = (agent.map.odds for agent in agents.values())
    assert a == pytest.approx(b, abs=1e-3)
    assert np.abs(a).max() > 1.0


def test_facts_contain_the_surest_place_without_a_claim() -> None:
    agent = searcher()
    agent.roster = Roster("a", ("a", "b"))
    agent.start(info("a", ("a", "b")))
    for second in range(4):
        for x, y in ((10.0, 30.0), (26.0, 14.0)):
            facts = agent.facts(observation((x, y, 20.0), second * S + int(x), looks=looks(x, y, second * S + int(x))))
    first, second_place = (9.0, 31.0), (27.0, 13.0)
    assert facts == {"shared": False, "probability": pytest.approx(9**4 / (1 + 9**4)), "place": second_place}
    body = {"do": "track", "ms": 4000, "tg": "", "at": [28.0, 12.0], "since": 3000}
    obs = observation((10.0, 30.0, 20.0), 5 * S, agent_loop.reception_of_body("b", body))
    agent.roster.hear(obs)
    assert agent.roster.claims(5 * S) == {"b": Claim("", (28.0, 12.0), 3 * S)}
    assert agent.facts(obs)["place"] == first
    agent.roster.give_up((9.5, 30.0), 0)
    facts = agent.facts(obs)
    assert facts["place"] is None
    assert facts["probability"] <= 0.99
    assert agent.facts(observation((10.0, 30.0, 20.0), 66 * S))["place"] is not None  # a minute later


def test_a_reading_without_looks_is_an_error() -> None:
    agent = searcher()
    agent.start(info("a", ("a",)))
    scan = Scan(ranges=np.ones(3, np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)
    with pytest.raises(TypeError, match="gives a Scan, not looks at cells"):
        agent.facts(observation((1.0, 1.0, 20.0), 0, looks=scan))


def test_a_map_of_too_many_cells_is_refused() -> None:
    with pytest.raises(ScenarioError, match="too many"):
        searcher(cell_m=0.01)


def test_the_second_in_a_sector_has_a_shared_sector() -> None:
    team = ("a", "b", "c")
    for name, shared in (("a", False), ("b", True), ("c", False)):
        agent = searcher(sectors=(("a", "b"),))
        agent.start(info(name, team))
        assert agent.facts(observation((1.0, 1.0, 20.0), 0))["shared"] is shared


def test_in_a_mission_the_clock_bound_is_that_of_the_mission() -> None:
    other, radio = searcher(), Radio("b", ("a", "b"))
    other.start(info("b", ("a", "b")))
    other.act(observation((9.0, 31.0, 20.0), 2 * S, looks=looks(9.0, 31.0, 2 * S)), radio)
    receptions = [reception_of(message) for message in radio.drain()]
    for bound_s, now_s, believed in ((0.0, 2.0, True), (0.0, 1.5, False), (0.5, 1.5, True), (0.4, 1.5, False)):
        agent = searcher()
        agent.roster = Roster("a", ("a", "b"), clock_bound_s=bound_s)
        agent.start(info("a", ("a", "b")))
        agent.stand_by(observation((30.0, 5.0, 20.0), round(now_s * S), *receptions), Radio("a", ("a", "b")))
        assert counts(agent).any() == believed


def test_it_shows_its_map_once_a_second() -> None:
    agent, radio = searcher(), Radio("a", ("a", "b"))
    agent.start(info("a", ("a", "b")))
    shown = []
    for tick in range(31):
        agent.act(observation((10.0, 30.0, 20.0), tick * S // 10, looks=looks(10.0, 30.0, tick // 10 * S)), radio)
        shown += [(tick, value) for value in agent.drain_shown().values()]
    assert [tick for tick, _ in shown] == [0, 10, 20, 30]
    last = shown[-1][1]
    assert isinstance(last, ProbabilityMap)
    assert last.probability[15, 4] == round(255 * 9**4 / (1 + 9**4))
    assert last.seen.ravel().nonzero()[0].tolist() == GRID.within(10.0, 30.0, REACH).tolist()


def test_it_keeps_height_and_heading_and_climbs_before_it_flies() -> None:
    radio = Radio("a", ("a",))
    for params, z, yaw, climb, moves in (
        ({}, 20.0, 0.0, 0.0, True),
        ({"height": 21.0}, 20.0, 0.0, 0.8, True),
        ({"height": 15.0}, 20.0, 0.0, -4.0, False),
        ({"height": 25.0}, 0.0, 0.0, 4.0, False),
    ):
        agent = searcher(**params)
        agent.start(info("a", ("a",)))
        command = agent.act(observation((20.0, 20.0, z), 0, yaw=0.5), radio)
        assert command.linear[2] == pytest.approx(climb)
        assert command.yaw_rate == 0.0
        assert (math.hypot(*command.linear[:2]) > 1.0) is moves
        assert agent.act(observation((20.0, 20.0, z), S, yaw=0.2 + yaw), radio).yaw_rate == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("params", "sensors", "problem"),
    [
        ({"sensor": "looks"}, ("camera",), "sensor = 'looks': a has no such sensor"),
        ({"sensor": "camera"}, ("camera",), "watching"),
        ({"members": ("a", "d")}, ("looks",), "members: unknown vehicle 'd'"),
        ({"members": ("b",)}, ("looks",), "members must include a"),
        ({"sectors": (("a", "d"),)}, ("looks",), "sectors: unknown member 'd'"),
        ({"prior": 1.0}, ("looks",), "prior"),
        ({"max_bytes": 39}, ("looks",), "max_bytes = 39: a map message needs at least 40 bytes"),
    ],
)
def test_parameters_unfit_for_the_vehicle_are_refused(params: dict[str, Any], sensors: tuple[str, ...], problem: str) -> None:
    agent = searcher(**params)
    with pytest.raises(ValueError, match=problem):
        agent.start(info("a", ("a", "b"), sensors))


def test_a_detector_without_a_width_is_refused() -> None:
    with pytest.raises(ScenarioError, match="set the width"):
        Search((0.0, 0.0, 1.0, 1.0), sensor="looks")


def test_vehicles_on_wheels_are_refused() -> None:
    body = Body(width_m=0.3, radius_m=0.2)
    with pytest.raises(ValueError, match="drives on wheels"):
        searcher().start(agent_loop.info(body=body))


class Sensorless(Search):
    def start(self, info: VehicleInfo) -> None:
        super().start(msgspec.structs.replace(info, sensors=None))


def test_it_satisfies_the_contract_of_agents() -> None:
    check_agent(lambda: Sensorless((-4.0, -4.0, 4.0, 4.0), sensor="looks", swath_m=2.0))


# --- search with a camera: pictures that count as looks, and lanes as wide as the footprint ---


PIXELS = (48, 64)
PICTURE = Image(pixels=np.zeros((*PIXELS, 3), np.uint8), focal_px=40.0)


class Flight:
    """A searcher at one place, with pictures at 5 Hz; its sensor covers 12 m to all sides from 20 m."""

    def __init__(self, **params: Any) -> None:
        self.agent, self.radio, self.frames = Search((0.0, 0.0, 40.0, 40.0), **params), Radio("a", ("a",)), list[Any]()
        self.agent.watch = SimpleNamespace(look=lambda _: self.frames[-1])  # type: ignore[assignment]
        self.agent.start(info("a", ("a",), ("camera",)))
        self.tick = -1

    def act(self, *places: tuple[float, float], picture: bool = True, z: float = 20.0, **change: Any) -> Velocity:
        self.tick += 1
        now_ns = self.tick * S // 5
        found = tuple(Sighting(target="x", place=at, centre_px=(1.0, 1.0), angle=0.0, side_px=4.0, score=1.0) for at in places)
        nadir = Nadir((20.0, 20.0, z), (1.0, 0.0, 0.0, 0.0), 40.0, PIXELS[1], PIXELS[0])
        frame = WatchFrame(now_ns, nadir, found, PICTURE, (0, 0, PIXELS[1], PIXELS[0]), True)
        self.frames.append(replace(frame, **change) if picture else None)
        return self.agent.act(observation((20.0, 20.0, z), now_ns), self.radio)

    @property
    def looks(self) -> int:
        return self.agent.map._mind.counts.sum(axis=(0, 1)).max()  # type: ignore[attr-defined]


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


def test_a_picture_counts_once_for_several_calls() -> None:
    flight = Flight(look_s=0.0)
    flight.act()
    obs = observation((20.0, 20.0, 20.0), 0)
    flight.agent.facts(obs)
    flight.agent.stand_by(obs, flight.radio)
    assert flight.looks == 1


def test_it_hovers_until_its_swath_is_known() -> None:
    flight = Flight()
    assert flight.act(picture=False).linear[:2] == (0.0, 0.0)
    assert flight.agent.goal is None
    assert flight.act().linear[:2] != (0.0, 0.0)
    assert flight.agent.goal in lanes(GRID.area, 12.0)


def test_the_swath_is_scaled_to_the_height_of_the_search() -> None:
    """12 m to all sides from 20 m is 6 m from 10 m."""
    flight = Flight(height=10.0)
    flight.act(z=20.0)
    flight.act(z=10.0)
    assert flight.agent.goal in lanes(GRID.area, 6.0)
    assert Flight(swath_m=7.0).act(picture=False).linear[:2] != (0.0, 0.0)
