from typing import Any

import pytest

from tests.support.netsim.channels import make_channel, send
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.presets import LAYERS, PRESETS, preset


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_sets_every_layer_and_delivers_to_a_neighbour(name: str) -> None:
    layers = preset(name)
    assert tuple(layers) == LAYERS
    assert all(layers[layer]["kind"] in builtin_kinds.KINDS[layer] for layer in LAYERS)
    assert send(make_channel(name), 5.0).outcome == ("received",)


@pytest.mark.parametrize("name", PRESETS)
def test_loss_and_delay_can_be_set_without_naming_a_kind(name: str) -> None:
    assert send(make_channel(name, loss={"probability": 1.0}), 5.0).outcome == ("random loss",)
    assert send(make_channel(name, delay={"seconds": 5.0}), 5.0).received_ns.tolist() == [5_000_000_000]


@pytest.mark.parametrize("kinds", [("none", "script"), ("script", "none"), ("script",)])
def test_the_only_kind_of_a_layer_need_not_be_named_wherever_it_stands(
    kinds: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = {kind: builtin_kinds.KINDS["script"][kind] for kind in kinds}
    monkeypatch.setattr(builtin_kinds, "KINDS", {**builtin_kinds.KINDS, "script": listed})
    script: dict[str, Any] = {"changes": [{"from_s": 0.0, "to_s": 1.0, "loss": 1.0}]}
    channel = make_channel("ideal", vehicles=["car0", "car1"], script=script)
    assert send(channel, 5.0).outcome == ("scripted outage",)


def test_a_preset_is_the_callers_own() -> None:
    preset("wss")["path_loss"]["exponent"] = 9.0
    assert preset("wss")["path_loss"]["exponent"] == 1.0
    preset("wifi-b-1")["path_loss"]["exponent"] = 9.0
    assert preset("zigbee")["path_loss"]["exponent"] == 3.0


def test_an_unknown_preset_is_refused_with_the_list_of_presets() -> None:
    with pytest.raises(ScenarioError, match="'wifi'; presets: ideal, wss, wifi-b-1, "):
        preset("wifi")
