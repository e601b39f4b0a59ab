"""Gusts: statistics, and dependence on seed, name and time only."""

import math
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.dynamics.quadrotor_laws import ground_effect
from vcmvsp.physics.dynamics.wind import AIR_KG_M3, GUST_HZ, Gusts, downwash
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.world.world import Wind

WINDY = Wind(velocity=(3.0, -1.0, 0.5), gust=1.5, gust_time_s=0.8)


def rows(count: int) -> list[str]:
    """Names of ``count`` vehicles."""
    return [str(number) for number in range(count)]


def series(gusts: Gusts, ticks: int) -> Any:
    """Gusts at every tick, (ticks, n, 3) m/s."""
    return np.array([gusts.advance(-(-tick * SECOND_NS // GUST_HZ)) for tick in range(ticks)])


def test_a_steady_wind_is_constant_and_equal_for_all() -> None:
    gusts = Gusts(Wind(velocity=(3.0, -1.0, 0.5)), rows(4), seed=1)
    for to_ns in (0, 1, SECOND_NS, 10**15):
        assert (gusts.advance(to_ns) == np.tile((3.0, -1.0, 0.5), (4, 1))).all()


def test_spread_and_mean_are_right_from_the_start() -> None:
    many = 4000
    gusts = Gusts(WINDY, rows(many), seed=1)
    for to_ns in (0, SECOND_NS // 3, 2 * SECOND_NS):
        wind = gusts.advance(to_ns)
        assert wind.mean(axis=0) == pytest.approx((3.0, -1.0, 0.5), abs=4 * 1.5 / math.sqrt(many))
        assert wind.std(axis=0) == pytest.approx((1.5, 1.5, 0.75), rel=4 / math.sqrt(2 * many))
        across = np.corrcoef(wind.T) - np.eye(3)
        assert across == pytest.approx(np.zeros((3, 3)), abs=4 / math.sqrt(many))


@pytest.mark.parametrize("gust_time_s", [0.01, 0.8, 5.0])
def test_correlation_in_time_is_exponential(gust_time_s: float) -> None:
    many = 4000
    wind = series(Gusts(Wind(gust=1.0, gust_time_s=gust_time_s), rows(many), seed=2), 61)
    for lag in (1, 12, 60):
        found = np.mean(wind[0] * wind[lag], axis=0) / (1.0, 1.0, 0.25)
        assert found == pytest.approx(math.exp(-lag / (GUST_HZ * gust_time_s)), abs=4 * math.sqrt(2 / many))


def test_gusts_do_not_depend_on_step_sizes() -> None:
    instants = [0, 1, 16_666_667, 16_666_668, 400_000_000, 7 * SECOND_NS, 7 * SECOND_NS + 5]
    often, seldom = Gusts(WINDY, rows(3), seed=3), Gusts(WINDY, rows(3), seed=3)
    between = sorted({*instants, *range(0, 7 * SECOND_NS, 3_333_333)})
    winds = {to_ns: often.advance(to_ns) for to_ns in between}
    for to_ns in instants:
        assert (seldom.advance(to_ns) == winds[to_ns]).all()


def test_the_wind_is_steady_between_its_ticks() -> None:
    gusts = Gusts(WINDY, rows(3), seed=3)
    first = gusts.advance(0)
    assert gusts.advance(16_666_665) is first
    second = gusts.advance(16_666_666)  # 1/60 s, rounded down to ns
    assert (second != first).all()
    assert gusts.advance(33_333_332) is second
    assert (gusts.advance(33_333_333) != second).all()


@pytest.mark.parametrize("hz", [60, 120, 240])
def test_each_gust_lasts_a_tick_at_any_rate_of_steps(hz: int) -> None:
    """Gust k starts at step k hz / 60, though both times are rounded to whole nanoseconds."""
    every, ticks = series(Gusts(WINDY, rows(1), seed=3), 1000), Ticks.rate(hz)
    gusts = Gusts(WINDY, rows(1), seed=3)
    stepped = np.array([gusts.advance(ticks.at(step)) for step in range(1000 * hz // GUST_HZ)])
    assert (stepped == np.repeat(every, hz // GUST_HZ, axis=0)).all()


def test_another_vehicle_changes_no_gusts() -> None:
    few, more = series(Gusts(WINDY, rows(2), seed=4), 600), series(Gusts(WINDY, rows(3), seed=4), 600)
    assert (few == more[:, :2]).all()
    named = series(Gusts(WINDY, ["car", "uav"], seed=4), 10)
    other = series(Gusts(WINDY, ["uav", "new", "car"], seed=4), 10)
    assert (named == other[:, [2, 0]]).all()


def test_seeds_and_vehicles_differ() -> None:
    one, two = Gusts(WINDY, rows(2), seed=5).advance(0), Gusts(WINDY, rows(2), seed=6).advance(0)
    assert len(np.unique(np.concatenate([one, two]))) == 12


def test_returned_arrays_never_change() -> None:
    gusts = Gusts(WINDY, rows(2), seed=7)
    first = gusts.advance(0)
    copy = first.copy()
    gusts.advance(SECOND_NS)
    assert (first == copy).all()
    assert not first.flags.writeable


R = 0.1016
WEIGHT = 0.8 * 9.81


@pytest.mark.parametrize(("radii", "factor"), [(0.5, 4 / 3), (1.0, 16 / 15), (2.0, 64 / 63), (100.0, 1.0), (0.0, 4 / 3)])
def test_thrust_near_the_floor(radii: float, factor: float) -> None:
    assert ground_effect(radii * R, R) == pytest.approx(factor, rel=1e-5)


def downwash_at(*places: tuple[float, float, float]) -> list[float]:
    """Downwash, m/s, of a hovering quadrotor at (0, 0, 10) at the places of weightless vehicles."""
    position = np.array([(0.0, 0.0, 10.0), *places]).T
    n = position.shape[1]
    speeds: list[float] = downwash(position, np.array([WEIGHT] + [0.0] * (n - 1)), np.full(n, R)).tolist()
    assert speeds[0] == 0.0
    return speeds[1:]


def test_the_wind_below_rotors_carries_their_weight() -> None:
    (close,) = downwash_at((0.0, 0.0, 9.7))
    area = 4 * math.pi * R**2
    assert AIR_KG_M3 * (0.5 * area) * close**2 == pytest.approx(WEIGHT)  # momentum of the jet, half as wide as the rotors


def test_downwash_decays_downwards_and_sideways_and_not_above() -> None:
    close, far, farther, aside, wide, above = downwash_at(
        (0, 0, 9.7), (0, 0, 5.0), (0, 0, 0.0), (0.094 * 5, 0, 5.0), (2.0, 0, 5.0), (0, 0, 10.3)
    )
    assert far < close
    assert farther == pytest.approx(far / 2)  # as 1 / distance
    assert aside == pytest.approx(far / 2)  # half width of the jet
    assert wide < 1e-3
    assert above == 0.0


def pair(*, upper: bool) -> QuadrotorFleet:
    models = [Quadrotor(downwash=True), Quadrotor(downwash=True)]
    return QuadrotorFleet(models, [(0.0, 0.0, 5.0), (0.0 if upper else 9.0, 0.0, 6.0)], [0.0, 0.0])


def test_downwash_pushes_by_drag() -> None:
    force, _ = pair(upper=True).wrench(1e-9, np.zeros((2, 3)))
    (speed,) = downwash_at((0.0, 0.0, 9.0))
    assert force[0, 2] == pytest.approx(WEIGHT - 0.35 * speed, rel=1e-6)
    assert force[1, 2] == pytest.approx(WEIGHT, rel=1e-6)
    alone, _ = pair(upper=False).wrench(1e-9, np.zeros((2, 3)))
    assert alone[:, 2] == pytest.approx(WEIGHT, rel=1e-6)


def test_ground_effect_is_optional() -> None:
    fleet = QuadrotorFleet([Quadrotor(ground_effect=True), Quadrotor()], [(0.0, 0.0, 0.05), (2.0, 0.0, 0.05)], [0.0, 0.0])
    force, _ = fleet.wrench(1e-9, np.zeros((2, 3)))
    assert force[:, 2] / WEIGHT == pytest.approx((4 / 3, 1.0), rel=0.02)


def test_the_autopilot_holds_its_height_in_both() -> None:
    fleet = pair(upper=True)
    fleet.set_waypoint(0, (0.0, 0.0, 5.0))
    fleet.set_waypoint(1, (0.0, 0.0, 6.0))
    fleet.fly(1200, 1 / 120, np.zeros((2, 3)))
    assert fleet.position[:, 2] == pytest.approx((5.0, 6.0), abs=0.01)
    assert fleet.rotor[0].mean() > 1.1 * fleet.rotor[1].mean()
