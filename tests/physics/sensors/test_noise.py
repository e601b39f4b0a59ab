"""Errors of readings: each part against its formula, and draws that no parameter moves."""

import numpy as np
import pytest

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array
from vcmvsp.physics.sensors.sensor import Errors, Noise, jump

N = 20_000


def sequence(noise: Noise, channels: int, times_s: Array) -> Array:
    """Errors of as many equal channels at these times, (t, channels)."""
    errors, rng = Errors([noise] * channels), stream(1, "noise")
    return np.array([errors.read(np.zeros(channels), round(1e9 * t), rng) for t in times_s])


def test_nothing_by_default() -> None:
    errors = Errors([Noise()] * 3)
    assert errors.read(np.array([1.0, -2.0, 3.0]), 0, stream(1, "a")).tolist() == [1.0, -2.0, 3.0]


def test_white_noise_has_the_stated_size_and_no_memory() -> None:
    e = sequence(Noise(sigma=0.3, bias=2.0), 1, np.arange(N) * 0.1)[:, 0]
    assert e.mean() == pytest.approx(2.0, abs=4 * 0.3 / N**0.5)
    assert e.std() == pytest.approx(0.3, rel=4 / (2 * N) ** 0.5)
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4 / N**0.5


def test_a_turn_on_bias_is_drawn_once() -> None:
    e = sequence(Noise(bias_sd=0.5, bias=1.0), N, np.arange(3.0))
    assert np.array_equal(e[0], e[2])
    assert e[0].mean() == pytest.approx(1.0, abs=4 * 0.5 / N**0.5)
    assert e[0].std() == pytest.approx(0.5, rel=4 / (2 * N) ** 0.5)


@pytest.mark.parametrize("times_s", [np.arange(61.0), np.array([0.0, 0.5, 10.0, 30.0, 60.0])])
def test_drift_is_stationary_and_forgets_exponentially_however_often_it_is_read(times_s: Array) -> None:
    """Autocorrelation sd^2 exp(-t / T)."""
    e = sequence(Noise(drift_sd=2.0, drift_time_s=20.0), N, times_s)
    assert e.std(axis=1) == pytest.approx(2.0, rel=5 / (2 * N) ** 0.5)
    for t, now in zip(times_s, e, strict=True):
        assert np.mean(now * e[0]) / 4.0 == pytest.approx(np.exp(-t / 20.0), abs=5 / N**0.5)


def test_a_walk_begins_at_nothing_and_grows_with_the_root_of_time() -> None:
    e = sequence(Noise(walk=0.1), N, np.array([5.0, 6.0, 9.0, 30.0]))
    assert not e[0].any()
    assert e.std(axis=1)[1:] == pytest.approx(0.1 * np.sqrt([1.0, 4.0, 25.0]), rel=4 / (2 * N) ** 0.5)
    assert np.corrcoef(e[3] - e[2], e[2])[0, 1] == pytest.approx(0.0, abs=4 / N**0.5)


def test_outliers_are_as_many_and_as_far_as_stated_on_both_sides() -> None:
    e = sequence(Noise(outlier_probability=0.1, outlier=7.0), N, np.zeros(1))[0]
    assert set(e.tolist()) == {-7.0, 0.0, 7.0}
    for side in (-7.0, 7.0):
        assert np.mean(e == side) == pytest.approx(0.05, abs=4 * (0.05 * 0.95 / N) ** 0.5)


def test_quantised_readings_are_the_nearest_multiples() -> None:
    truth = np.linspace(-1.0, 1.0, 333)
    read = Errors([Noise(quantum=0.03)] * 333).read(truth, 0, stream(1, "a"))
    assert np.abs(read / 0.03 - np.round(read / 0.03)).max() < 1e-9
    assert np.abs(read - truth).max() <= 0.015 + 1e-12
    assert np.unique(read).size > 60


def test_channels_may_differ() -> None:
    rng, errors = stream(1, "a"), Errors([Noise(sigma=1.0), Noise(quantum=0.5), Noise(bias=3.0)])
    first, second, third = np.array([errors.read(np.full(3, 0.3), t, rng) for t in range(500)]).T
    assert first.std() == pytest.approx(1.0, rel=4 / 1000**0.5)
    assert set(second.tolist()) == {0.5}
    assert third == pytest.approx(3.3)


def test_no_parameter_moves_the_draws() -> None:
    """The generator stands at the same place after any reading, and what one parameter adds does not depend on another."""
    times, zero = (0, 10**8, 10**9), np.zeros(2)
    every = Noise(bias=1.0, bias_sd=1.0, drift_sd=1.0, walk=1.0, sigma=1.0, outlier_probability=0.5, outlier=9.0, quantum=0.1)
    a, b = stream(1, "a"), stream(1, "a")
    plain, full = Errors([Noise()] * 2), Errors([every] * 2)
    for now in times:
        plain.read(zero, now, a)
        full.read(zero, now, b)
    assert a.random() == b.random()
    parts = (Noise(bias_sd=1.0), Noise(drift_sd=1.0), Noise(walk=1.0), Noise(sigma=1.0))
    sums = sum(sequence(part, 2, np.array([0.0, 1.0, 4.0])) for part in parts)
    whole = sequence(Noise(bias_sd=1.0, drift_sd=1.0, walk=1.0, sigma=1.0), 2, np.array([0.0, 1.0, 4.0]))
    assert whole == pytest.approx(sums)


def test_jumps_are_as_many_and_as_far_as_stated_in_all_directions() -> None:
    rng = stream(1, "jump")
    jumps = np.array([jump(0.2, 3.0, rng) for _ in range(N)])
    far = np.hypot(*jumps.T)
    assert far[far > 0.0] == pytest.approx(3.0)
    assert np.mean(far > 0.0) == pytest.approx(0.2, abs=4 * (0.2 * 0.8 / N) ** 0.5)
    assert np.abs(jumps[far > 0.0].mean(axis=0)).max() < 4 * 3.0 / (0.5**0.5 * (0.2 * N) ** 0.5)


def test_as_a_table_of_a_scenario() -> None:
    def sensor(noise: Noise) -> Noise:
        return noise

    assert binding.call(sensor, {"noise": {"sigma": 1, "quantum": 0.5}}) == Noise(sigma=1.0, quantum=0.5)
    for bad in ({"sigma": -1.0}, {"outlier_probability": 1.5}, {"drift_time_s": 0.0}, {"sigmas": 1.0}):
        with pytest.raises(ScenarioError, match=next(iter(bad))) as refused:
            binding.call(sensor, {"noise": bad}, key="vehicle.car.sensors.alt")
        assert refused.value.key.startswith("vehicle.car.sensors.alt.noise")
