"""Loss, age and range through the whole platform, against closed forms."""

import math

import numpy as np
import pytest

import vcmvsp
from tests.support.validation.fleets import K1, LEFT_BEHIND, RIGHT_BEHIND, UNLIMITED, T, V, errors, fleet, lossy

pytestmark = pytest.mark.slow

FOLLOWERS = 30
FROM_S = 20.0


def mean_age_s(result: vcmvsp.Result, sender: str, receiver: str) -> float:
    """Mean age of information over continuous time: area under a sawtooth that rises at 1 s/s and falls at receptions."""
    rows = result.radio.to_pandas()
    rows = rows[(rows.sender == sender) & (rows.receiver == receiver)].dropna(subset="received_ns")
    sent, received = (rows[name].to_numpy(float) / 1e9 for name in ("sent_ns", "received_ns"))
    begin, end = received[:-1] - sent[:-1], received[1:] - sent[:-1]  # age after and before each reception
    return float((end**2 - begin**2).sum() / 2 / (received[-1] - received[0]))


@pytest.mark.parametrize("p", [0.3, 0.7])
def test_loss_on_a_straight_line(p: float) -> None:
    """Independent losses p, ``hold`` on a straight leader, age d = T without loss; alpha = 1 - k1 T:

    mean |z| = v (d + T p/(1-p)),  var = v^2 (k1 T)^2/(1-alpha^2) T^2 p/(1-p)^2 (1+alpha p)/(1-alpha p),
    mean age at ticks = d + T p/(1-p),  over continuous time d' + T (1+p)/(2 (1-p)) with the delay d' of a message.
    """
    agents = {"estimator": "hold", **UNLIMITED}
    scenario = fleet(160.0, [RIGHT_BEHIND, LEFT_BEHIND] * (FOLLOWERS // 2), path="straight", radio=lossy(p), agents=agents)
    result = vcmvsp.run(scenario, set={"record.period_s": 0.5, "metrics.from_s": FROM_S}, mcap=False)
    alpha, d = 1 - K1 * T, T
    mean = V * (d + T * p / (1 - p))
    var = (V * K1 * T) ** 2 / (1 - alpha**2) * T**2 * p / (1 - p) ** 2 * (1 + alpha * p) / (1 - alpha * p)

    formation, radio = result.metrics["formation"], result.metrics["radio"]
    assert formation["mean_m"] == pytest.approx(mean, rel=0.04)
    assert formation["rms_m"] == pytest.approx(math.sqrt(mean**2 + var), rel=0.04)
    times, z = errors(result)
    z = z[times >= FROM_S]
    assert np.hypot(z[..., 0], z[..., 1]).mean() == pytest.approx(formation["mean_m"], rel=1e-9)  # computed twice
    assert z[..., 0].var() == pytest.approx(var, rel=0.17)  # separately, as the mean dominates the RMS
    assert radio["age_s"]["mean"] == pytest.approx(d + T * p / (1 - p), rel=0.02)
    frames = radio["frames"] * FOLLOWERS
    assert radio["delivery_ratio"] == pytest.approx(1 - p, abs=5 * math.sqrt(p * (1 - p) / frames))
    continuous = np.mean([mean_age_s(result, "car1", f"car{number}") for number in range(2, FOLLOWERS + 2)])
    assert continuous == pytest.approx(radio["delay_s"]["mean"] + T * (1 + p) / (2 * (1 - p)), rel=0.02)


def test_a_link_keeps_its_draws_when_vehicles_are_added() -> None:
    """Losses and delays from car1 to car2, in fleets of three and of six vehicles that all send."""
    radio = lossy(0.3, 0.05, 0.04)
    links = []
    for followers in (2, 5):
        names = [{**RIGHT_BEHIND, "pose": (-1.0 - number, -0.5, 0.0)} for number in range(followers)]
        scenario = fleet(30.0, names, radio=radio, agents={"broadcast": followers > 2})
        rows = vcmvsp.run(scenario, mcap=False).radio.to_pandas()
        link = rows[(rows.sender == "car1") & (rows.receiver == "car2")]
        links.append(link[["sent_ns", "received_ns", "outcome", "delay_ns"]].astype(object).to_numpy().tolist())
    assert len(links[0]) == 300
    assert 50 < sum(row[2] == "random loss" for row in links[0]) < 130
    assert str(links[0]) == str(links[1])
