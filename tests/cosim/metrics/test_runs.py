"""Metrics of whole runs: closed forms through the platform, and the set of keys."""

import json
import math

import numpy as np
import pytest

import vcmvsp
from tests.support.validation.fleets import UNLIMITED, T, V, fleet, lossy
from vcmvsp.cosim.studies.rows import flat
from vcmvsp.cosim.terminal.progress import summary


@pytest.mark.parametrize(("k1", "start"), [(0.8, 0.5), (2.0, 0.5), (12.0, 0.3)])
def test_response_of_a_kinematic_follower(k1: float, start: float) -> None:
    """z grows by v T until the first report takes effect, then by the factor 1 - k1 T per period."""
    follower = {"pose": (-1.0 - start, 0.0, 0.0), "k1": k1, **UNLIMITED}
    metrics = vcmvsp.run(fleet(20.0, [follower], path="straight", radio={"preset": "ideal"}), mcap=False).metrics
    z = np.array([start, *((start + V * T) * (1 - k1 * T) ** np.arange(200))])
    falling = z[: np.argmax(np.abs(z) < 0.05 * start)]
    rate = -np.polyfit(T * np.arange(len(falling)), np.log(np.abs(falling)), 1)[0]
    formation = metrics["formation"]
    assert formation["overshoot"] == pytest.approx(max(0.0, -z.min() / start), abs=1e-9)
    assert formation["convergence_1_s"] == pytest.approx(rate, rel=1e-6)
    command = [0.0, *(V + k1 * z[1:200])]  # at each tick, by the law
    assert metrics["control"]["per_vehicle"]["car2"]["effort_m2_s"] == pytest.approx(T * np.square(command).sum(), rel=1e-6)


def test_keys_do_not_depend_on_chance() -> None:
    """For all seeds and losses, except the keys of the causes of loss."""
    keys = []
    for seed, p in ((1, 0.0), (2, 0.3), (3, 1.0)):
        metrics = vcmvsp.run(fleet(2.0, radio=lossy(p)), seed=seed, mcap=False).metrics
        values = flat(metrics)
        json.dumps(metrics, allow_nan=False)
        assert all(value is None or isinstance(value, str | int | float) for value in values.values())
        keys.append([key for key in values if not key.startswith("radio.losses.")])
    assert keys[0] == keys[1] == keys[2]
    assert {"formation.shape.rms_m", "formation.per_follower.car3.hop_gain", "control.per_vehicle.car1.effort_m2_s"} <= {
        *keys[0]
    }


def test_errors_of_a_chain_add_up_in_its_shape() -> None:
    """On a straight line with ``hold``, each vehicle is too far behind its predecessor by speed times age: the column is too
    long.

    The ages are T: car2 is 1.03 m behind car1, car3 as far behind car2; both ends are 0.03 m too far from the middle. The
    printed summary of a chain contains the shape error.
    """
    behind = {"estimator": "hold", "bearing_deg": 0.0, "handle": 0.5, "broadcast": True, **UNLIMITED}
    chain = [behind, {**behind, "leader": "car2", "pose": (-2.0, 0.0, 0.0)}]
    scenario = fleet(60.0, chain, path="straight", radio={"preset": "ideal"}, metrics={"from_s": 50.0})
    result = vcmvsp.run(scenario, mcap=False)
    formation = result.metrics["formation"]
    assert [each["rms_m"] for each in formation["per_follower"].values()] == pytest.approx([V * T, V * T], rel=1e-6)
    assert formation["hop_gain"] == pytest.approx(1.0, rel=1e-6)
    assert formation["shape"]["rms_m"] == pytest.approx(V * T * math.sqrt(2 / 3), rel=1e-6)
    assert "error 0.0300 m RMS, 0.0300 m at most, shape 0.0245 m off a rigid one, " in summary(result)
    star = vcmvsp.run(fleet(5.0, path="straight", radio={"preset": "ideal"}), mcap=False)
    assert "shape" not in summary(star)  # in a star only if above the link errors
