"""Shape, overshoot, convergence and gain of formations, from motions with known answers."""

import cmath
import json
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import TENTH, follows, metrics_after, states
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.formation import misfit_squared
from vcmvsp.cosim.types import Follows

T = 0.1
CORNERS = {"a": 0j, "b": -1 + 1j, "c": -1 - 1j, "d": -2 + 0j}  # a diamond with leader "a"
TREE = [("b", "a"), ("c", "a"), ("d", "c")]


def formation_of(names: str, events: Sequence[Event], window: tuple[float, float | None] = (0.0, None)) -> dict[str, Any]:
    end_ns = max(event.time_ns for event in events)
    result = metrics_after(names, events, end_ns, window)
    json.dumps(result, allow_nan=False)
    return result["formation"]


def at(places: dict[str, complex], yaw: float = 0.0) -> dict[str, tuple[float, float, float]]:
    return {name: (place.real, place.imag, yaw) for name, place in places.items()}


def diamond(time_ns: int = 0) -> list[Event]:
    """Follows events of the diamond; slots are in the frame of each member's leader."""
    slots = [(name, leader, CORNERS[name] - CORNERS[leader]) for name, leader in TREE]
    return [follows(name, leader, (slot.real, slot.imag), 0.3, time_ns) for name, leader, slot in slots]


# --- the shape ------------------------------------------------------------------------------------------------------------


@given(st.floats(-math.pi, math.pi), st.complex_numbers(max_magnitude=100.0), st.floats(-math.pi, math.pi))
@settings(deadline=None, max_examples=30)
def test_the_shape_ignores_position_and_heading(turn: float, shift: complex, yaw: float) -> None:
    places = {name: shift + cmath.exp(1j * turn) * corner for name, corner in CORNERS.items()}
    shape = formation_of("abcd", [*diamond(), states(0, at(places, yaw))])["shape"]
    assert max(shape.values()) < 1e-12


def test_on_a_circle_the_shape_errs_but_no_link_does() -> None:
    """Two vehicles: the error of each is half of rho_d - rho; rho = 0.83666 m at R = 2 m, L' = 0.5 m, rho_d = 1 m, handle L."""
    ahead, side, radius = math.sqrt(3) / 2, 0.5, 2.0
    own = math.sqrt((radius + side) ** 2 - ahead**2)
    events = [follows("b", "a", (-ahead, -side), ahead)]
    for k in range(20):
        angle = 0.015 * k
        late = angle - math.atan2(ahead, own)
        a, b = cmath.rect(radius, angle), cmath.rect(own, late)
        events.append(
            states(TENTH.at(k), {"a": (a.real, a.imag, angle + math.pi / 2), "b": (b.real, b.imag, late + math.pi / 2)})
        )
    formation = formation_of("ab", events)
    assert formation["max_m"] < 1e-12
    assert formation["shape"] == pytest.approx(dict.fromkeys(("rms_m", "max_m", "final_m"), (1.0 - 0.83666) / 2), abs=1e-5)


def test_an_error_of_a_leader_counts_once_in_the_shape() -> None:
    """c is in its slot behind b; b is 0.4 m too far back. The shape's error is the RMS about the mean of the row."""
    slots = [follows("b", "a", (-1.0, 0.0), 0.3), follows("c", "b", (-1.0, 0.0), 0.3)]
    formation = formation_of("abc", [*slots, states(0, at({"a": 0j, "b": -1.4 + 0j, "c": -2.4 + 0j}))])
    off = np.array([0.0, -0.4, -0.4]) - np.mean([0.0, -0.4, -0.4])
    assert formation["shape"]["final_m"] == pytest.approx(math.sqrt(np.mean(off**2)))
    assert formation["per_follower"]["c"]["final_m"] == pytest.approx(0.0, abs=1e-12)


def test_the_shape_covers_all_teams_at_the_time() -> None:
    """From 0.2 s on, d follows b, two metres behind it; e and f are a second team; g has no team."""
    places = {**CORNERS, "e": 50 + 0j, "f": 49 + 0j, "g": 9 + 9j}
    moved = {**places, "d": -3 + 1j}
    events = [*diamond(), follows("f", "e", (-1.0, 0.0), 0.3), follows("d", "b", (-2.0, 0.0), 0.3, TENTH.at(2))]
    events += [states(TENTH.at(k), at(moved if k >= 3 else places, 0.7)) for k in range(6)]
    formation = formation_of("abcdefg", events, window=(0.3, None))
    assert formation["shape"]["rms_m"] < 1e-12
    wrong = [CORNERS[name] for name in "abcd"], [*(CORNERS[name] for name in "abc"), -3 + 1j]
    misfit = float(misfit_squared(np.array(wrong[:1]), np.array(wrong[1]))[0])
    assert formation_of("abcdefg", events)["shape"]["max_m"] == pytest.approx(math.sqrt(misfit / 6))


def test_a_ring_of_followers_has_a_shape() -> None:
    ring = [follows("b", "a", (-1.0, 0.0), 0.3), follows("c", "b", (0.0, 1.0), 0.3), follows("a", "c", (1.0, -1.0), 0.3)]
    places = {"a": 0j, "b": -1 + 0j, "c": -1 + 1j}
    assert formation_of("abc", [*ring, states(0, at(places))])["shape"]["max_m"] < 1e-12
    away = {name: 3 * place for name, place in places.items()}
    assert formation_of("abc", [*ring, states(0, at(away))])["shape"]["max_m"] > 0.5


def test_an_incomplete_and_a_parted_team_have_no_shape() -> None:
    pair = {"a": 0j, "b": -1 + 0j}
    events = [follows("b", "a", (-1.0, 0.0), 0.3), states(0, at(pair)), states(TENTH.at(1), at({"a": 5 + 0j}))]
    shape = formation_of("ab", events)["shape"]
    assert shape["rms_m"] == pytest.approx(0.0, abs=1e-12)
    assert shape["final_m"] is None
    parted = [*events[:2], Event("b/follows", TENTH.at(1), Follows(leader=None)), states(TENTH.at(1), at({**pair, "b": 9j}))]
    assert formation_of("ab", parted)["shape"]["final_m"] is None


points = st.lists(st.complex_numbers(max_magnitude=10.0, allow_nan=False), min_size=4, max_size=4)


@given(points, points)
@settings(deadline=None, max_examples=100)
def test_misfit_equals_kabsch_by_singular_values(places: list[complex], slots: list[complex]) -> None:
    p, d = (np.stack([np.real(each), np.imag(each)], axis=1) for each in (places, slots))
    p, d = p - p.mean(axis=0), d - d.mean(axis=0)
    u, _, vt = np.linalg.svd(d.T @ p)
    flip = np.diag([1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    expected = ((p - d @ u @ flip @ vt) ** 2).sum()
    assert misfit_squared(np.array([places]), np.array(slots))[0] == pytest.approx(expected, rel=1e-9, abs=1e-10)


def test_coincident_vehicles_err_by_the_size_of_the_formation() -> None:
    """Also at a distance below the smallest normal number: division by it overflows."""
    for apart in (0.0, 2.0**-1040, 1e-300):
        assert misfit_squared(np.array([[0j, apart * 1j]]), np.array([0j, -1.0 + 0.5j]))[0] == pytest.approx(0.5 * 1.25)


# --- responses ------------------------------------------------------------------------------------------------------------


def response(z: Sequence[complex], yaw: Sequence[float] | None = None, place_ns: int = 0) -> dict[str, Any]:
    """Formation metrics of a follower that turns, with error z in its own frame (handle 0.3 m); the leader turns at another
    rate.
    """
    events = [follows("b", "a", (-1.0, 0.4), 0.3, place_ns)]
    for k, error in enumerate(z):
        th_l, th_f = 0.05 * k, yaw[k] if yaw else -0.1 * k
        point = 3 - 2j + 0.03 * k + cmath.exp(1j * th_l) * (-1.0 + 0.3 + 0.4j)
        centre = point - cmath.exp(1j * th_f) * (error + 0.3)
        events.append(states(TENTH.at(k), {"a": (3 + 0.03 * k, -2.0, th_l), "b": (centre.real, centre.imag, th_f)}))
    return formation_of("ab", events)


def servo(k1: float, n: int = 120, start: float = 0.5) -> list[complex]:
    """z1 of the sampled loop with a servo of 0.5 s at 10 Hz: state (z1, v_f - v_l)."""
    tau = 0.5
    decay = math.exp(-T / tau)
    settle = tau * (1 - decay)
    matrix = np.array([[1 - k1 * (T - settle), -settle], [(1 - decay) * k1, decay]])
    state, z = np.array([start, 0.0]), []
    for _ in range(n):
        z.append(complex(state[0]))
        state = matrix @ state
    return z


@pytest.mark.parametrize(("k1", "overshoot"), [(0.4, 0.0), (0.8, 0.026), (2.0, 0.206), (4.0, 0.396), (8.0, 0.622)])
@pytest.mark.parametrize("direction", [1, 1j, -1, cmath.exp(2.3j)])
def test_overshoot_of_a_servo_in_any_direction(k1: float, overshoot: float, direction: complex) -> None:
    """Toh 2012, Fig 30 (start behind the slot; Fig 31: beside it), from the exact matrix."""
    formation = response([direction * z for z in servo(k1)])
    assert formation["overshoot"] == pytest.approx(overshoot, abs=5e-4)
    assert formation["per_follower"]["b"]["overshoot"] == formation["overshoot"]


@pytest.mark.parametrize("k1", [0.2, 0.8, 2.0, 5.0, 8.0])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_rate_of_a_geometric_decay(k1: float, noise: float) -> None:
    """-ln(1 - k1 T)/T, also with a residual error of 1 mm."""
    left = noise * np.exp(1j * np.arange(400))
    z = [0.5 * 1j * (1 - k1 * T) ** n + left[n] for n in range(400)]
    formation = response([complex(each) for each in z])
    assert formation["convergence_1_s"] == pytest.approx(-math.log(1 - k1 * T) / T, rel=1e-9 if noise == 0.0 else 0.04)


def test_residual_noise_ends_the_fitted_decay() -> None:
    """Noise of 4 cm under a decay from 0.5 m: the fit ends at 8 cm, above the noise."""
    rng = np.random.default_rng(5)
    z = 0.5 * 0.92 ** np.arange(600) + 0.04 * (rng.standard_normal(600) + 1j * rng.standard_normal(600)) / math.sqrt(2)
    assert response([complex(each) for each in z])["convergence_1_s"] == pytest.approx(-math.log(0.92) / T, rel=0.15)


@pytest.mark.parametrize(
    ("z", "overshoot"),
    [
        ([0.04 * (-0.9) ** n for n in range(60)], None),  # starts in its slot
        ([0.5 - 0.001 * n for n in range(40)], 0.0),  # hardly decreases
        ([0.5 * 1.1**n for n in range(40)], 0.0),  # increases
        ([0.5, *[0.0] * 40], 0.0),  # in its slot after one step: nothing between to fit
        ([0.5], 0.0),
    ],
)
def test_without_a_decay_there_is_no_rate(z: list[float], overshoot: float | None) -> None:
    formation = response([complex(each) for each in z])
    assert formation["convergence_1_s"] is None
    assert formation["overshoot"] == (None if overshoot is None else pytest.approx(overshoot, abs=1e-12))


def test_the_largest_step_of_several_slots_counts() -> None:
    """A start 0.1 m off, and at 6 s a new slot 0.5 m away: overshoot 0.6 and 0.2 of these steps."""
    slots = {0: -1.0, 60: -1.5}
    events = [follows("b", "a", (slot, 0.0), 0.3, TENTH.at(k)) for k, slot in slots.items()]
    z = [0.1 * (-0.6) ** n for n in range(60)] + [0.5 * (-0.2) ** n for n in range(60)]
    for k, error in enumerate(z):
        slot = slots[0] if k < 60 else slots[60]
        events.append(states(TENTH.at(k), {"a": (0.0, 0.0, 0.0), "b": (slot - error, 0.0, 0.0)}))
    formation = formation_of("ab", events)
    assert formation["overshoot"] == pytest.approx(0.2)
    assert formation["convergence_1_s"] == pytest.approx(-math.log(0.2) / T)
    assert formation["settling_s"] == pytest.approx(6.2)


# --- several followers ----------------------------------------------------------------------------------------------------


def in_a_row(errors: Mapping[str, Sequence[float]]) -> list[Event]:
    """Vehicles in a chain, each 1 m plus its error, m, behind its leader; one error per tick."""
    names = ["a", *errors]
    events = [follows(name, leader, (-1.0, 0.0), 0.3) for leader, name in pairwise(names)]
    for k in range(len(errors["b"])):
        places, x = {"a": 0j}, 0.0
        for name, own in errors.items():
            x -= 1.0 + own[k]
            places[name] = complex(x)
        events.append(states(TENTH.at(k), at(places)))
    return events


def test_hop_gain_is_the_growth_from_link_to_link() -> None:
    b = [0.1 * math.sin(0.3 * k) for k in range(50)]
    formation = formation_of("abcd", in_a_row({"b": b, "c": [1.5 * z for z in b], "d": [0.75 * z for z in b]}))
    gains = {name: each["hop_gain"] for name, each in formation["per_follower"].items()}
    assert gains == {"b": None, "c": pytest.approx(1.5), "d": pytest.approx(0.5)}
    assert formation["hop_gain"] == pytest.approx(1.5)
    star = [*diamond()[:2], *(states(TENTH.at(k), at({**CORNERS, "b": -0.9 + 1j})) for k in range(3))]
    assert formation_of("abcd", star)["hop_gain"] is None


def test_hop_gain_is_of_the_window_and_never_of_rounding() -> None:
    b, c = [0.2] * 5 + [0.1] * 5, [0.2] * 5 + [0.05] * 5
    events = in_a_row({"b": b, "c": c})
    assert formation_of("abc", events, window=(0.5, None))["hop_gain"] == pytest.approx(0.5)
    assert formation_of("abc", in_a_row({"b": [1e-9] * 5, "c": [1e-9] * 5}))["hop_gain"] is None


def test_worst_of_the_followers() -> None:
    k1 = {"b": 12.0, "c": 16.0, "d": 1.0}
    errors = {name: [0.5 * (1 - k * T) ** n for n in range(80)] for name, k in k1.items()}
    formation = formation_of("abcd", in_a_row(errors))
    assert formation["overshoot"] == pytest.approx(0.6)
    assert formation["convergence_1_s"] == pytest.approx(min(-math.log(abs(1 - k * T)) / T for k in k1.values()))
    settled = [each["settling_s"] for each in formation["per_follower"].values()]
    for name, settling_s in zip(k1, settled, strict=True):
        assert settling_s == pytest.approx(next(n for n, z in enumerate(errors[name]) if abs(z) <= 0.05) * T)
    assert formation["settling_s"] == max(settled)


def test_time_zero_is_the_start_even_if_little_is_recorded() -> None:
    events = [follows("b", "a", (-1.0, 0.0), 0.3), states(SECOND_NS, at({"a": 0j, "b": 1 + 0j}))]
    assert formation_of("ab", events)["overshoot"] == 0
