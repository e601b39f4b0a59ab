"""The consensus protocol in its own loop: spectra, the stability bound under delay, and validity of received reports."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Floats, info, observe, present, reception_of_body
from vcmvsp.agents.formation.followers.consensus import Consensus, Graph, neighbours_of
from vcmvsp.agents.formation.followers.laws import axle_velocity, hand_point
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.cosim.agent import Body, Radio
from vcmvsp.cosim.types import Follows, Velocity

pytestmark = pytest.mark.slow

T_NS = 100_000_000
Sides = tuple[tuple[int, ...], ...]  # neighbours of each member


def names(count: int) -> tuple[str, ...]:
    return tuple(f"m{i}" for i in range(count))


def sides_of(graph: Graph, count: int) -> Sides:
    return tuple(neighbours_of(graph, i, count) for i in range(count))


def laplacian(sides: Sides) -> Floats:
    matrix = np.zeros((len(sides), len(sides)))
    for i, neighbours in enumerate(sides):
        matrix[i, i] = len(neighbours)
        matrix[i, list(neighbours)] = -1.0
    return matrix


def team(sides: Sides, period_ns: int = T_NS, **params: Any) -> list[Consensus]:
    everybody = names(len(sides))
    agents = [Consensus(neighbours=tuple(everybody[j] for j in each), **{"timeout_s": 1e9, **params}) for each in sides]
    for name, agent in zip(everybody, agents, strict=True):
        agent.start(info(name, everybody, period_s=period_ns / 1e9))
    return agents


def alone(vehicles: Sequence[str] = ("m0", "m1"), **params: Any) -> Consensus:
    agent = Consensus(**params)
    agent.start(info("m0", tuple(vehicles)))
    return agent


def report(sender: str, tick: float, x: float, y: float = 0.0, **more: Any) -> Any:
    body = {"t_ns": round(tick * T_NS), "x": x, "y": y, **more}
    return reception_of_body(sender, body)


def drive(
    agents: Sequence[Consensus],
    start: Floats,
    ticks: int,
    age: int,
    *,
    period_ns: int = T_NS,
    lost: Callable[[int, int], bool] = lambda tick, member: False,
) -> Floats:
    """Positions, (ticks + 1, members, 2), of points without lag that receive all reports ``age`` ticks late."""
    everybody = names(len(agents))
    radios = [Radio(name, everybody) for name in everybody]
    on_air: list[list[Any]] = []
    way = [start]
    for tick in range(ticks):
        here, now_ns = way[-1], tick * period_ns
        bodies = [{"t_ns": now_ns, "x": x, "y": y} for x, y in here.tolist()]
        on_air.append([reception_of_body(n, b) for n, b in zip(everybody, bodies, strict=True)])
        receptions = on_air[tick - age] if tick >= age else []
        speeds = np.empty_like(here)
        for i, (agent, radio) in enumerate(zip(agents, radios, strict=True)):
            obs = observe((here[i, 0], here[i, 1], 0.0), now_ns, () if lost(tick, i) else receptions)
            speeds[i] = agent.act(obs, radio).linear[:2]
            assert [message.body for message in radio.drain()] == [bodies[i]]
        way.append(here + speeds * (period_ns / 1e9))
    return np.array(way)


@st.composite
def connected(draw: st.DrawFn) -> Sides:
    """Any connected undirected graph: a random tree and some more edges."""
    count = draw(st.integers(2, 7))
    edges = {(draw(st.integers(0, i - 1)), i) for i in range(1, count)}
    edges |= draw(st.sets(st.sampled_from(list(itertools.combinations(range(count), 2)))))
    return tuple(tuple(j for j in range(count) if (min(i, j), max(i, j)) in edges) for i in range(count))


@pytest.mark.parametrize("count", range(2, 9))
def test_largest_eigenvalues_have_closed_forms(count: int) -> None:
    """Complete and star: N; ring: 2 - 2 cos(2 pi floor(N/2) / N); path: 2 + 2 cos(pi / N)."""
    expected = {
        "complete": count,
        "star": count,
        "path": 2.0 + 2.0 * math.cos(math.pi / count),
        "ring": 2.0 - 2.0 * math.cos(math.tau * (count // 2) / count) if count > 2 else 2.0,
    }
    for graph in ("complete", "star", "ring", "path"):
        values = np.linalg.eigvalsh(laplacian(sides_of(graph, count)))
        assert values[-1] == pytest.approx(expected[graph])
        assert values[1] > 1e-9  # connected


@given(sides=connected(), own=st.sampled_from(["fresh", "delayed"]), data=st.data())
def test_without_delay_the_mean_stays_and_disagreement_decays_with_lambda_2(
    sides: Sides, own: str, data: st.DataObject
) -> None:
    """Every mode by 1 - kappa lambda T a tick."""
    place = st.floats(-10, 10)
    start = np.array(data.draw(st.lists(st.tuples(place, place), min_size=len(sides), max_size=len(sides))))
    matrix = laplacian(sides)
    way = drive(team(sides, own=own, gain=0.4), start, 30, 0)
    values = np.linalg.eigvalsh(matrix)
    assert way[-1] == pytest.approx(np.linalg.matrix_power(np.eye(len(sides)) - 0.04 * matrix, 30) @ start, abs=1e-9)
    assert way.mean(axis=1) == pytest.approx(np.broadcast_to(start.mean(axis=0), (31, 2)), abs=1e-9)
    off = np.linalg.norm(way - way.mean(axis=1, keepdims=True), axis=(1, 2))
    assert np.all(off[1:] <= off[:-1] * (1.0 - 0.04 * values[1]) + 1e-9)


@settings(max_examples=12)
@given(sides=connected(), age=st.integers(0, 5), seed=st.integers(0, 99))
def test_both_points_delayed_any_connected_graph_is_stable_up_to_the_sampled_bound(sides: Sides, age: int, seed: int) -> None:
    """kappa lambda_max T < 2 sin(pi / (2 (2 d + 1))): 5 % below it any start decays, 5 % above it the last mode grows."""
    values, modes = np.linalg.eigh(laplacian(sides))
    bound = 2.0 * math.sin(math.pi / (2 * (2 * age + 1))) / (0.1 * values[-1])
    random = np.random.default_rng(seed).normal(size=(len(sides), 2))
    start = {0.95: random - random.mean(axis=0), 1.05: modes[:, -1:] * np.array([1.0, -0.5])}
    size = {}
    for factor, begin in start.items():
        way = np.abs(drive(team(sides, own="delayed", gain=factor * bound), begin, 240, age)).max(axis=(1, 2))
        size[factor] = way[60:120].max(), way[180:].max()
    assert size[0.95][1] < size[0.95][0]
    assert size[1.05][1] > size[1.05][0]


@settings(max_examples=12)
@given(sides=connected(), age=st.integers(0, 40), loss=st.sampled_from([0.0, 0.5, 0.9]), seed=st.integers(0, 99))
def test_with_the_own_point_fresh_all_stay_in_the_hull_and_meet(sides: Sides, age: int, loss: float, seed: int) -> None:
    """For kappa T degree < 1 each point moves to a weighted mean of received points, for any age and losses."""
    draw = np.random.default_rng(seed)
    gain = 0.9 / (0.1 * max(map(len, sides)))
    start = draw.uniform(-1.0, 1.0, (len(sides), 2))
    way = drive(team(sides, gain=gain), start, 300, age, lost=lambda tick, member: bool(draw.random() < loss))
    assert np.all(way.max(axis=(0, 1)) <= start.max(axis=0) + 1e-12)
    assert np.all(way.min(axis=(0, 1)) >= start.min(axis=0) - 1e-12)
    if loss == 0.0 and age <= 2:
        spread = np.ptp(way, axis=1).max(axis=1)
        assert spread[-1] < 0.5 * spread[: age + 1].max()


@pytest.mark.parametrize("own", ["fresh", "delayed"])
@pytest.mark.parametrize("age", [0, 1, 3])
def test_a_common_velocity_only_moves_the_frame(own: str, age: int) -> None:
    sides = sides_of("path", 4)
    start = np.random.default_rng(2).uniform(-1.0, 1.0, (4, 2))
    still = drive(team(sides, own=own), start, 80, age)
    moving = drive(team(sides, own=own, velocity=(0.3, -0.2)), start, 80, age)
    time = 0.1 * np.arange(81)
    assert moving - time[:, None, None] * np.array([0.3, -0.2]) == pytest.approx(still, abs=1e-12)


@pytest.mark.parametrize("graph", ["complete", "ring", "path", "star"])
def test_the_points_converge_to_the_formation(graph: Graph) -> None:
    """Wedge of five, facing north: 2 m apart, the second right-behind the first, i.e. to the south-east."""
    agents = team(sides_of(graph, 5), formation=Formation(shape="wedge", spacing=2.0), heading=math.pi / 2)
    way = drive(agents, np.random.default_rng(3).uniform(-5.0, 5.0, (5, 2)), 800, 1)
    half, deep = 1.0, math.sqrt(3.0)
    expected = [(half, -deep), (-half, -deep), (2 * half, -2 * deep), (-2 * half, -2 * deep)]
    assert way[-1, 1:] - way[-1, 0] == pytest.approx(np.array(expected), abs=1e-6)


def test_a_change_of_shape_comes_for_all_at_its_time() -> None:
    formation = Formation(shape="wedge", spacing=2.0, changes=((30.0, "column"), (60.0, "line")))
    agents = team(sides_of("ring", 5), formation=formation)
    way = drive(agents, np.zeros((5, 2)), 900, 1)
    aside = way - way[:, :1]
    assert np.abs(aside[300, :, 1]).max() > 1.9
    assert aside[600] == pytest.approx(np.outer(np.arange(5), [-2.0, 0.0]), abs=1e-6)
    assert aside[900] == pytest.approx(np.array([(0, 0), (0, -2), (0, 2), (0, -4), (0, 4)]), abs=1e-6)
    assert agents[1].follows == Follows(leader="m0", slot=(0.0, -2.0))


@pytest.mark.parametrize("graph", ["complete", "ring", "path", "star"])
def test_errors_are_measured_along_a_tree(graph: Graph) -> None:
    """Each against an earlier neighbour: no cycle of errors, and one member without error."""
    for member in range(6):
        agent = Consensus(graph=graph, formation=Formation(shape="column"), heading=1.0)
        agent.start(info(f"m{member}", names(6)))
        assert (agent.follows is None) == (member == 0)
        if agent.follows is not None:
            leader = names(6).index(present(agent.follows.leader))
            assert leader < member
            assert agent.follows.slot == pytest.approx((leader - member, 0.0))


def test_on_wheels_errors_are_measured_with_a_common_heading() -> None:
    column = Formation(shape="column")
    params = {"formation": column, "graph": "path", "handle": 0.3, "heading": math.pi / 2}
    standing, moving = Consensus(**params), Consensus(**params, velocity=(0.2, 0.0))  # type: ignore[arg-type]
    standing.start(info("m1", names(2)))
    moving.start(info("m1", names(2)))
    assert standing.follows is None
    follows = present(moving.follows)
    assert follows.slot == pytest.approx((0.0, -1.0))  # south of the first member, which heads east
    assert follows.handle_m == 0.3


@given(yaw=st.floats(-7, 7), x=st.floats(-3, 3), y=st.floats(-3, 3), handle=st.floats(0.05, 1.0))
def test_on_wheels_the_hand_point_moves_by_the_protocol(yaw: float, x: float, y: float, handle: float) -> None:
    agent = alone(handle=handle, gain=0.7, velocity=(0.1, 0.2))
    command = agent.act(observe((0.5, -0.5, yaw), 0, [report("m1", 0, x, y)]), Radio("m0", ("m0", "m1")))
    hand_x, hand_y = hand_point(0.5, -0.5, yaw, handle)
    v, w = axle_velocity(0.1 + 0.7 * (x - hand_x), 0.2 + 0.7 * (y - hand_y), yaw, handle)
    assert (*command.linear, command.yaw_rate) == pytest.approx((v, 0.0, 0.0, w), abs=1e-9)


def test_in_the_air_they_turn_to_the_heading_of_the_formation() -> None:
    command = alone(heading=math.pi, gain=0.5).act(observe((0.0, 0.0, -3.0), 0), Radio("m0", ("m0", "m1")))
    assert command.yaw_rate == pytest.approx(0.5 * (3.0 - math.pi))  # the shorter way round


@given(x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_a_limit_of_speed_keeps_the_direction(x: float, y: float) -> None:
    limited, free = (
        alone(max_speed=limit, gain=2.0).act(observe((0.0, 0.0, 0.0), 0, [report("m1", 0, x, y)]), Radio("m0", ("m0", "m1")))
        for limit in (1.5, None)
    )
    speed = math.hypot(*free.linear)
    assert math.hypot(*limited.linear) == pytest.approx(min(1.5, speed), abs=1e-12)
    assert np.array(limited.linear) * max(speed, 1.5) == pytest.approx(np.array(free.linear) * 1.5, abs=1e-6)


def test_without_reception_it_has_the_common_velocity() -> None:
    agent = alone(velocity=(0.2, 0.1))
    assert agent.act(observe((5.0, 5.0, 0.0), 0), Radio("m0", ("m0", "m1"))) == Velocity(linear=(0.2, 0.1, 0.0))
    assert agent.drain_notes() == {"heard": 0.0}


def test_a_neighbour_that_falls_silent_is_left_out_and_taken_back() -> None:
    agent, radio = alone(names(3), timeout_s=1.0), Radio("m0", names(3))
    agent.act(observe((0.0, 0.0, 0.0), 0, [report("m1", 0, 3.0), report("m2", 0, -1.0)]), radio)
    assert agent.drain_notes() == {"heard": 2.0, "age_s": 0.0, "disagreement": math.sqrt(5.0)}
    only_m2 = agent.act(observe((0.0, 0.0, 0.0), 10 * T_NS, [report("m2", 9, -1.0)]), radio)
    assert only_m2.linear == (-1.0, 0.0, 0.0)
    assert agent.drain_notes() == {"heard": 1.0, "age_s": pytest.approx(0.1), "disagreement": 1.0}
    back = agent.act(observe((0.0, 0.0, 0.0), 11 * T_NS, [report("m1", 11, 3.0)]), radio)
    assert back.linear == (2.0, 0.0, 0.0)


NONSENSE = st.one_of(
    st.binary(max_size=8),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=3),
    st.builds(
        lambda key, value: {"t_ns": 0, "x": 9.0, "y": 9.0, key: value},
        st.sampled_from(["x", "y"]),
        st.sampled_from([math.nan, math.inf, -math.inf, 1e300, None, "1", [1.0], {}]),
    ),
    st.builds(lambda t: {"t_ns": t, "x": 9.0, "y": 9.0}, st.sampled_from([20 * T_NS + 1, 2**62, 0.5, math.nan, None, True])),
)


@given(ticks=st.lists(st.integers(0, 20), min_size=1, max_size=6), garbage=st.lists(NONSENSE, max_size=4), data=st.data())
def test_the_newest_report_wins_over_late_ones_copies_and_nonsense(
    ticks: list[int], garbage: list[Any], data: st.DataObject
) -> None:
    good = [report("m1", tick, float(tick), extra=1) for tick in ticks]
    bad = [reception_of_body("m1", body) for body in garbage]
    stranger = [report("somebody", 20, 99.0), report("m0", 20, 99.0)]
    agent = alone()
    mixed = data.draw(st.permutations(good + bad + stranger))
    command = agent.act(observe((0.0, 0.0, 0.0), 20 * T_NS, mixed), Radio("m0", ("m0", "m1")))
    assert command.linear == (float(max(ticks)), 0.0, 0.0)
    assert agent.drain_notes().pop("refused", 0) == sum(
        not isinstance(body, bytes) for body in garbage
    )  # bytes are messages of other programs


def test_a_clock_ahead_within_its_bound_is_accepted_with_age_zero() -> None:
    early = report("m1", 1.05, 1.0)
    for bound_s, neighbours in ((0.0, 0.0), (0.005, 1.0)):
        agent = alone(clock_bound_s=bound_s)
        agent.act(observe((0.0, 0.0, 0.0), T_NS, [early]), Radio("m0", ("m0", "m1")))
        assert agent.drain_notes()["heard"] == neighbours


@given(tick=st.floats(0.0, 30.0))
def test_the_delayed_own_point_is_interpolated_between_ticks(tick: float) -> None:
    """Straight motion at constant speed beside the neighbour: no error."""
    agent, radio = alone(own="delayed", timeout_s=4.0), Radio("m0", ("m0", "m1"))
    for i in range(31):
        receptions = [report("m1", tick, 0.02 * tick, 0.01 * tick)] if i == 30 else []
        agent.act(observe((0.02 * i, 0.01 * i, 0.0), i * T_NS, receptions), radio)
    assert agent.drain_notes()["disagreement"] == pytest.approx(0.0, abs=1e-9)


def test_the_own_past_is_kept_for_the_maximum_age_of_reports() -> None:
    agent, radio = alone(own="delayed", timeout_s=1.0), Radio("m0", ("m0", "m1"))
    for i in range(100):
        agent.act(observe((0.0, 0.0, 0.0), i * T_NS), radio)
    assert 11 <= len(agent._past) <= 12


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"formation": Formation(members=("m1", "m2"))}, "does not contain m0"),
        ({"neighbours": ("m7",)}, "'m7' is not another member"),
        ({"neighbours": ("m0",)}, "'m0' is not another member"),
    ],
)
def test_names_that_do_not_fit_are_refused(params: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        alone(names(3), **params)


def test_a_vehicle_on_wheels_needs_a_handle() -> None:
    on_wheels = info("m0", ("m0", "m1"), body=Body(width_m=0.4, radius_m=0.25))
    with pytest.raises(ValueError, match="handle is missing"):
        Consensus().start(on_wheels)
    Consensus(handle=0.3).start(on_wheels)
    Consensus().start(msgspec.structs.replace(on_wheels, body=Body(width_m=0.4, radius_m=0.25, flies=True)))
