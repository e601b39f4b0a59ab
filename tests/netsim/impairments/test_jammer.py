"""Jammers: when they transmit, where they are, and their level at receivers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.jammer import Emitter, Jammer
from vcmvsp.netsim.interfaces.layers import Floats, Paths
from vcmvsp.netsim.propagation.path_loss import LogDistance

MS = 1_000_000
HERE = (0.0, 0.0, 0.0)
RX = np.array([[10.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 1000.0]])
SQUARE = LogDistance(exponent=2.0, reference_distance_m=1.0, reference_loss_db=40.0)


def loss_db(tx: Floats, rx: Floats) -> Floats:
    return SQUARE.loss_db(Paths.between(tx, rx))


def received_mw(*sources: Emitter, at_ns: int = 0, air_ns: int = MS, cars: Mapping[str, Any] | None = None) -> list[float]:
    found = Jammer(sources).interference_mw(at_ns, at_ns + air_ns, RX, loss_db, lambda name: np.array((cars or {})[name]))
    assert found.shape == (3,)
    return found.tolist()


def on(source: Emitter, at_ns: int, air_ns: int) -> bool:
    return received_mw(source, at_ns=at_ns, air_ns=air_ns)[0] > 0.0


def test_a_jammer_arrives_with_its_power_less_the_path_loss() -> None:
    """20 dBm less 60, 80 and 100 dB at 10, 100 and 1000 m: -40, -60, -80 dBm."""
    assert received_mw(Emitter(power_dbm=20.0, position=HERE)) == pytest.approx([1e-4, 1e-6, 1e-8], rel=1e-12)


def test_powers_of_jammers_add_up() -> None:
    one, two = Emitter(power_dbm=20.0, position=(3.0, 0.0, 0.0)), Emitter(power_dbm=-7.0, position=(0.0, 90.0, 5.0))
    assert received_mw(one, two) == pytest.approx(np.add(received_mw(one), received_mw(two)), rel=1e-12)
    assert received_mw() == [0.0, 0.0, 0.0]


def test_a_jammer_on_a_vehicle_is_where_the_vehicle_is() -> None:
    riding = Emitter(power_dbm=20.0, vehicle="car4")
    for place in ((1.0, 2.0, 3.0), (-40.0, 7.0, 0.0)):
        assert received_mw(riding, cars={"car4": place}) == received_mw(Emitter(power_dbm=20.0, position=place))
    assert Jammer((riding, Emitter(power_dbm=1.0, vehicle="car2"), riding)).names() == ("car4", "car2")


@pytest.mark.parametrize(
    ("t_s", "place"),
    [
        (0.0, (0.0, 0.0, 0.0)),
        (10.0, (0.0, 0.0, 0.0)),
        (11.0, (4.0, 0.0, 0.0)),
        (15.0, (20.0, 0.0, 0.0)),
        (17.5, (20.0, 5.0, -1.0)),
        (20.0, (20.0, 10.0, -2.0)),
        (99.0, (20.0, 10.0, -2.0)),
    ],
)
def test_a_jammer_moves_along_its_path(t_s: float, place: tuple[float, float, float]) -> None:
    path = ((10.0, 0.0, 0.0, 0.0), (15.0, 20.0, 0.0, 0.0), (20.0, 20.0, 10.0, -2.0))
    moving, standing = Emitter(power_dbm=20.0, path=path), Emitter(power_dbm=20.0, position=place)
    assert received_mw(moving, at_ns=round(t_s * 1e9)) == pytest.approx(received_mw(standing), rel=1e-9)


def test_a_pulse_has_full_power() -> None:
    source = Emitter(power_dbm=0.0, position=HERE, from_s=0.005, to_s=0.025, duty=0.2, period_s=0.01)
    assert received_mw(source, at_ns=6 * MS) == received_mw(Emitter(power_dbm=0.0, position=HERE))


@given(
    st.integers(0, 3000),
    st.integers(1, 6000),
    st.integers(0, 40_000),
    st.integers(1, 9000),
    st.integers(1000, 5000),
    st.floats(0.001, 1.0),
)
def test_on_is_when_any_nanosecond_is(begin: int, length: int, start: int, air: int, period: int, duty: float) -> None:
    """Compared with a scan of every pulse, in whole ns."""
    end, pulse = begin + 5 * length, max(1, round(duty * period))
    source = Emitter(power_dbm=0.0, position=HERE, from_s=begin / 1e9, to_s=end / 1e9, duty=duty, period_s=period / 1e9)
    pulses = ((begin + k * period, min(begin + k * period + pulse, end)) for k in range(5 * length // period + 1))
    assert on(source, start, air) == any(max(first, start) < min(last, start + air) for first, last in pulses)


def test_a_fractional_period_does_not_drift() -> None:
    """1000.5 ns: pulse 2 000 000 begins at 2.001 s to the nanosecond."""
    source = Emitter(power_dbm=0.0, position=HERE, duty=0.5, period_s=1.0005e-6)
    assert [on(source, 2_001_000_000 + t, 1) for t in (-1, 0)] == [False, True]


STANDING: dict[str, Any] = {"power_dbm": 20.0, "position": [0.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({"power_dbm": 20.0}, r"a jammer needs exactly one of position, vehicle and path"),
        (STANDING | {"vehicle": "car1"}, r"a jammer needs exactly one of position, vehicle and path"),
        ({"power_dbm": 20.0, "path": []}, r"path must have points \[t, x, y, z\], each later than the one before"),
        ({"power_dbm": 20.0, "path": [[1, 0, 0, 0], [1, 2, 0, 0]]}, r"path must have points"),
        (STANDING | {"from_s": 3.0, "to_s": 3.0}, r"to_s = 3 must be greater than from_s = 3"),
        (STANDING | {"duty": 0.3}, r"duty = 0.3 is a pulsed jammer, which needs period_s"),
        (STANDING | {"duty": 0.0, "period_s": 1.0}, r"must be a number > 0 and <= 1, not 0.0"),
        (STANDING | {"power_w": 1.0}, r"unknown key 'power_w'; did you mean 'power_dbm'\?"),
        ({"position": [0, 0, 0]}, r"power_dbm is missing"),
    ],
)
def test_bad_parameters_are_refused_with_their_key(source: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        binding.call(Jammer, {"sources": [source]}, key="radio.jammer")
    assert raised.value.key == "radio.jammer.sources[0]" + (".duty" if "must be a number" in message else "")
