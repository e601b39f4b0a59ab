"""Several radios: separate channels do not interact, one channel is one medium, and agents choose the radio."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import vcmvsp
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.runs.replay import replay

WIFI = {"name": "wifi", "preset": "wifi-b-1", "loss": {"probability": 0.3}, "fading": {"kind": "nakagami", "m": 1.0}}
LORA = {"name": "lora", "preset": "lora-sf7", "mac": {"kind": "aloha", "duty_cycle": 0.5}, "shadowing": {"sigma_db": 6.0}}
KINEMATIC = {"kind": "kinematic", "agent": {}}
SHARED = [{**WIFI, "name": name, "channel": "6"} for name in "ab"]  # two networks on one channel
TURNS: dict[str, Any] = {f"car{i}": {"radios": ["ab"[i % 2]]} for i in range(4)}


class Both(vcmvsp.Agent):
    """Sends on each of some radios at each tick, and collects receptions."""

    def __init__(self, *names: str) -> None:
        self.names, self.received = names, list[tuple[str, str | None, Any]]()

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity:
        self.received += [(each.message.sender, each.radio, each.message.body) for each in obs.heard]
        for name in self.names:
            radio[name].send(on=name)
        return vcmvsp.Velocity(linear=(0.5, 0.0, 0.0))


def scenario(*radios: dict[str, Any], vehicles: int = 4, **own: Any) -> dict[str, Any]:
    cars = [{**KINEMATIC, "name": f"car{i}", "position": [12.0 * i, 5.0 * i * i, 0.0]} for i in range(vehicles)]
    listed = [{**car, **own.get(str(car["name"]), {})} for car in cars]
    return {"name": "radios", "duration_s": 3.0, "physics": {"kind": "kinematic"}, "radio": [*radios], "vehicle": listed}


def run(content: dict[str, Any], *names: str, **others: tuple[str, ...]) -> tuple[vcmvsp.Result, dict[str, Both]]:
    agents = {each["name"]: Both(*others.get(each["name"], names)) for each in content["vehicle"]}
    return vcmvsp.run(content, agents=agents, mcap=False), agents


def rows(result: vcmvsp.Result, name: str) -> pd.DataFrame:
    """Frames of one radio, without their numbers in the run."""
    frames = result.radio.to_pandas()
    own = frames[frames.radio == name].drop(columns=["frame", "radio"])
    return own.astype({"sender": str, "receiver": str, "outcome": str}).reset_index(drop=True)


def test_networks_on_separate_channels_are_independent() -> None:
    members: dict[str, Any] = {"car3": {"radios": ["wifi"]}}
    both, _ = run(scenario(WIFI, LORA, **members), "wifi", "lora", car3=("wifi",))
    wifi, _ = run(scenario(WIFI, vehicles=4), "wifi")
    lora, _ = run(scenario(LORA, vehicles=3), "lora")
    for alone, name in ((wifi, "wifi"), (lora, "lora")):
        assert len(rows(both, name)) > 100
        pd.testing.assert_frame_equal(rows(both, name), rows(alone, name))
    assert both.states.equals(wifi.states)


def test_networks_on_one_channel_are_one_medium() -> None:
    """Two networks of LoRa: frames of both overlap, and none is 6 dB above the other at a receiver at equal distances."""
    parts: dict[str, Any] = {f"car{i}": {"radios": ["aabb"[i]]} for i in range(4)}
    outcomes = {}
    for channel in ("1", "2"):
        pair = ({**LORA, "name": "a", "channel": "1"}, {**LORA, "name": "b", "channel": channel})
        content = scenario(*({**each, "mac": {"kind": "aloha", "duty_cycle": 1.0}} for each in pair), **parts)
        for number, each in enumerate(content["vehicle"]):
            each["position"] = [10.0 * (number % 2), 10.0 * (number // 2), 0.0]  # a square
        result, agents = run(content, car0=("a",), car1=(), car2=("b",), car3=())
        frames = result.radio.to_pandas().astype({"outcome": str})
        assert set(zip(frames.sender, frames.receiver, strict=True)) == {("car0", "car1"), ("car2", "car3")}
        outcomes[channel] = set(frames.outcome)
        assert {each[1] for agent in agents.values() for each in agent.received} <= {"a", "b"}
    assert "collision" in outcomes["1"]
    assert outcomes["2"] == {"received"}


def test_receptions_name_their_radio_and_the_first_one_is_the_default() -> None:
    class Plain(Both):
        def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity:
            radio.send(on="the first")
            return super().act(obs, radio)

    content = scenario({"name": "fast", "preset": "ideal"}, {"name": "slow", "preset": "ideal"}, vehicles=2)
    agents = {"car0": Plain("slow"), "car1": Plain()}
    vcmvsp.run(content, agents=agents, mcap=False)
    assert {(radio, body["on"]) for _, radio, body in agents["car1"].received} == {("fast", "the first"), ("slow", "slow")}
    assert {(radio, body["on"]) for _, radio, body in agents["car0"].received} == {("fast", "the first")}


def test_a_radio_reaches_only_vehicles_that_have_it() -> None:
    radio = Radio("car0", ("car0", "car1", "car2"), {"wifi": ("car0", "car1"), "lora": ("car0", "car2")})
    radio["lora"].send(to="car2")
    with pytest.raises(ValueError, match="unknown receiver"):
        radio.send(to="car2")
    with pytest.raises(KeyError, match="wifi, lora"):
        radio["zigbee"]
    with pytest.raises(ValueError, match="car0 has no radio"):
        Radio("car0", ("car0", "car1"), {"wifi": ("car1",)}).send(x=1)
    assert [message.radio for message in radio.drain()] == ["lora"]
    assert radio.drain() == []


def test_the_resolved_scenario_gives_the_same_bytes(tmp_path: Path) -> None:
    content = scenario(WIFI, LORA, car1={"radio": {"antenna_gain_dbi": 3.0, "lora": {"tx_power_dbm": 20.0}}})
    content["vehicle"] = [{**each, "agent": {"kind": "trajectory", "path": "straight"}} for each in content["vehicle"]]
    vcmvsp.run(content, out=tmp_path / "one")
    vcmvsp.run(tmp_path / "one" / "scenario.toml", out=tmp_path / "two")
    for name in ("run.mcap", "radio.parquet", "metrics.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_an_intervention_on_one_radio_leaves_the_other_as_it_was() -> None:
    content = scenario(WIFI, LORA)
    order = {"kind": "set", "at_s": 1.0, "key": "radio.wifi.loss.probability", "value": 1.0}
    before, _ = run(content, "wifi", "lora")
    after, _ = run({**content, "intervention": [order]}, "wifi", "lora")
    pd.testing.assert_frame_equal(rows(after, "lora"), rows(before, "lora"))
    late = rows(after, "wifi").query("sent_ns >= 1_000_000_000")
    assert len(late) > 100
    assert set(late.outcome) & {"received", "random loss"} == {"random loss"}
    early = "sent_ns < 990_000_000"  # decided before the change
    pd.testing.assert_frame_equal(rows(after, "wifi").query(early), rows(before, "wifi").query(early))


def test_an_outage_is_of_all_radios_of_a_vehicle() -> None:
    order = {"kind": "outage", "at_s": 0.0, "for_s": 9.0, "vehicles": ["car0"]}
    result, _ = run({**scenario(WIFI, LORA), "intervention": [order]}, "wifi", "lora")
    for name in ("wifi", "lora"):
        own = rows(result, name).query("sender == 'car0' or receiver == 'car0'")
        assert len(own) > 50
        assert "received" not in set(own.outcome)


@pytest.mark.parametrize("key", ["radio.loss.probability", "radio.b.loss.probability", "radio.lora.phy.spreading_factor"])
def test_an_intervention_names_the_radio(key: str) -> None:
    """Two networks on one channel are one medium, addressed by the first name."""
    parts: dict[str, Any] = {f"car{i}": {"radios": ["ab"[i % 2], "lora"]} for i in range(4)}
    order = {"kind": "set", "at_s": 1.0, "key": key, "value": 0.5}
    with pytest.raises(vcmvsp.ScenarioError) as caught:
        run({**scenario(*SHARED, LORA, **parts), "intervention": [order]})
    assert f"{key} cannot change during a run; keys that can: radio.a.loss.probability, " in str(caught.value)
    assert "radio.lora.loss.probability" in str(caught.value)


def repeated(folder: Path, content: dict[str, Any], **names: tuple[str, ...]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Frames of a run, and of its replay with its frames and other draws."""
    tables: list[pd.DataFrame] = []
    for _ in range(2):
        agents = {each["name"]: Both(*names[each["name"]]) for each in content["vehicle"]}
        if not tables:
            result = vcmvsp.run(content, agents=agents, out=folder)
        else:
            result = replay(folder, agents=agents, radio="recorded", seed=99, mcap=False)
        tables.append(result.radio.to_pandas().sort_values(["frame", "receiver"]).reset_index(drop=True))
    return tables[0], tables[1]


def test_a_replay_repeats_the_frames_of_all_radios(tmp_path: Path) -> None:
    content = scenario(WIFI, LORA, car3={"radios": ["wifi"]})
    names: dict[str, Any] = {**{f"car{i}": ("wifi", "lora") for i in range(3)}, "car3": ("wifi",)}
    before, after = repeated(tmp_path, content, **names)
    assert set(before.radio) == {"wifi", "lora"}
    assert len(set(before.outcome)) > 2
    pd.testing.assert_frame_equal(before, after)


def test_a_replay_repeats_the_frames_of_networks_on_one_channel(tmp_path: Path) -> None:
    content = scenario(*SHARED, **TURNS)
    before, after = repeated(tmp_path, content, **{f"car{i}": ("ab"[i % 2],) for i in range(4)})
    assert set(zip(before.radio, before.sender, before.receiver, strict=True)) == {
        *(("a", one, other) for one, other in (("car0", "car2"), ("car2", "car0"))),
        *(("b", one, other) for one, other in (("car1", "car3"), ("car3", "car1"))),
    }
    pd.testing.assert_frame_equal(before, after)


def test_frames_of_one_radio_are_not_repeated_by_several(tmp_path: Path) -> None:
    run_of: dict[str, Any] = {"agents": {f"car{i}": Both() for i in range(2)}}
    vcmvsp.run(scenario(WIFI, LORA, vehicles=2), out=tmp_path / "several", **run_of)
    vcmvsp.run({**scenario(vehicles=2), "radio": {}}, out=tmp_path / "one", **run_of)
    with pytest.raises(vcmvsp.UsageError, match=r"several radios \(.*\), not of one"):
        vcmvsp.run(tmp_path / "one" / "scenario.toml", recorded_radio=tmp_path / "several" / "radio.parquet", **run_of)
    with pytest.raises(vcmvsp.UsageError, match="has no column radio"):
        vcmvsp.run(tmp_path / "several" / "scenario.toml", recorded_radio=tmp_path / "one" / "radio.parquet", **run_of)


def chain(**own: Any) -> dict[str, Any]:
    """Four vehicles in a line at rest; the radio ``wifi`` reaches the next one, ``lora`` all; car3 has no wifi."""
    content = scenario({"name": "wifi", "preset": "wifi-b-1"}, LORA, car3={"radios": ["lora"]})
    for number, each in enumerate(content["vehicle"]):
        each["position"] = [60.0 * number, 0.0, 0.0]
    return {**content, **own}


class Still(Both):
    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity:
        super().act(obs, radio)
        return vcmvsp.Velocity()


@pytest.mark.parametrize("kind", ["flooding", "distance_vector"])
def test_messages_are_forwarded_over_the_named_radio_alone(kind: str) -> None:
    """Equal rows but for the numbers in the run, which count the frames of both."""
    results, receptions = [], []
    for routing in ({}, {"routing": {"kind": kind, "radio": "wifi"}}):
        agents = {f"car{i}": Still(*(("wifi",) if i < 3 else ()), "lora") for i in range(4)}
        result = vcmvsp.run(chain(**routing), agents=agents, mcap=False)
        results.append(result)
        receptions.append({(sender, name) for sender, name, _ in agents["car2"].received})
    without, routed = results
    relayed = ["origin", "destination", "origin_sent_ns", "origin_number", "message"]
    pd.testing.assert_frame_equal(rows(routed, "lora").drop(columns=relayed), rows(without, "lora"))
    assert ("car0", "wifi") not in receptions[0]
    assert ("car0", "wifi") in receptions[1]
    frames = routed.radio.to_pandas().astype({"origin": str, "sender": str, "receiver": str})
    assert frames.frame.is_monotonic_increasing
    assert "car3" not in set(frames[frames.radio == "wifi"].receiver)
    assert set(frames[(frames.radio == "wifi") & (frames.origin == "car0") & (frames.receiver == "car2")].sender) >= {"car1"}
    direct = frames[frames.radio == "lora"]
    assert (direct.origin == direct.sender).all()
    assert (direct.origin_sent_ns == direct.sent_ns).all()


@pytest.mark.parametrize(
    ("radios", "own", "settings", "message"),
    [
        ([WIFI, WIFI], {}, {}, "radio: two radios have one name"),
        ([{"preset": "zigbee"}], {}, {}, "radio[0].name: is missing"),
        ([WIFI], {"car0": {"radios": ["lora"]}}, {}, "vehicle.car0.radios"),
        ([WIFI, {**WIFI, "name": "b", "channel": "wifi"}], {}, {}, "radio.b.channel: car0 has also wifi"),
        ([WIFI, {**LORA, "phy": {"kind": "lora", "sf": 7}}], {}, {}, "radio.lora.phy.sf"),
        ([WIFI, LORA], {}, {"radio.lora.loss.probability": 2.0}, "radio.lora.loss.probability"),
        ([WIFI, LORA], {}, {"routing.kind": "flooding"}, "routing.radio: is missing"),
        ([WIFI, LORA], {}, {"routing": {"kind": "flooding", "radio": "zigbee"}}, "routing.radio: unknown radio 'zigbee'"),
        (SHARED, TURNS, {"routing": {"kind": "flooding", "radio": "a"}}, "routing.radio: a shares its channel with b"),
        ([SHARED[0], {**LORA, "name": "b", "channel": "6"}], TURNS, {}, "radio.b: has the channel of a"),
    ],
)
def test_wrong_tables_end_with_one_line(
    radios: list[dict[str, Any]], own: dict[str, Any], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(vcmvsp.ScenarioError) as caught:
        vcmvsp.run(scenario(*radios, **own), agents={}, set=settings, mcap=False)
    assert message in str(caught.value)
