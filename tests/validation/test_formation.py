"""The formation law through the whole platform: closed forms and reference numbers of Toh 2012, section 3.3, corrected."""

import numpy as np
import pytest

import vcmvsp
from tests.support.validation.fleets import K1, UNLIMITED, T, V, errors, fleet, lossy

pytestmark = pytest.mark.slow


def test_a_body_settles_later_than_a_point() -> None:
    """A start in the slot with p2dx bodies in Bullet, which take 0.9 s to reach 90 % of 0.3 m/s."""
    scenario = fleet(10.0, [{}], path="straight", kind="p2dx", physics={"kind": "bullet"})
    body = vcmvsp.run(scenario, set={"vehicle.car1.kind": "kinematic"}, mcap=False)
    point = vcmvsp.run(scenario, set={"vehicle.car1.kind": "kinematic", "physics.kind": "kinematic"}, mcap=False)
    assert point.metrics["formation"]["settling_s"] == 0.0
    assert 2.0 < body.metrics["formation"]["settling_s"] < 3.0


def test_the_platform_adds_nothing_to_the_law() -> None:
    """A start off the slot decays by (1 - k1 T) a period, to rounding: no delay and no lost sample."""
    result = vcmvsp.run(fleet(10.0, [{"pose": (-1.5, 0.0, 0.0), **UNLIMITED}], path="straight"), mcap=False)
    times, z = errors(result)
    offset_m = 0.5 + V * T  # the first report acts at the second tick
    assert z[1:, 0, 0] == pytest.approx(offset_m * (1 - K1 * T) ** np.arange(len(times) - 1), abs=1e-12)


@pytest.mark.parametrize("path", ["straight", "circle"])
@pytest.mark.parametrize(("probability", "delay_s"), [(0.0, 0.0), (0.0, 1.0), (0.6, 0.0), (0.6, 0.3)])
def test_dead_reckoning_has_no_error_on_lines_and_circles(path: str, probability: float, delay_s: float) -> None:
    """For any loss and delay: the leader's speeds are constant."""
    result = vcmvsp.run(
        fleet(70.0, path=path, radio=lossy(probability, delay_s, 0.02 if delay_s else 0.0), agents=UNLIMITED), mcap=False
    )
    assert result.metrics["formation"]["final_m"] < 1e-6
