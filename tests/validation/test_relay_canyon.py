"""Relays around two corners: coverage with rays, and with walls only."""

import pytest

import vcmvsp

RELAYS = "vehicle.relay.count"
FAST = {"agents.speed": 4.0, "duration_s": 57.5}


@pytest.mark.processes
@pytest.mark.slow
def test_rays_reach_around_corners_and_walls_do_not() -> None:
    """A second relay helps with rays, and hardly if all links without line of sight are lost; at twice the speed."""
    shares = []
    for keys in (
        {"radio.path_loss.reflections": 0},
        {"radio.path_loss": {"kind": "log_distance"}, "radio.walls.kind": "itu"},
    ):
        table = vcmvsp.study(
            "relay-canyon", vary={RELAYS: [1, 2]}, seeds=1, metrics=["routing.delivery_ratio"], set={**keys, **FAST}, jobs=1
        )
        shares.append(table.to_pandas().sort_values(RELAYS)["routing.delivery_ratio"].tolist())
    rays, walls = shares
    assert rays[1] > rays[0] + 0.05
    assert rays[0] > walls[0]
    assert rays[1] > walls[1] + 0.1
    assert walls[1] == pytest.approx(walls[0], abs=0.1)
