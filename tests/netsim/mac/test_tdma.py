"""Time division: slots by the clocks of vehicles, guard times, and what drift costs."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.netsim.channels import make_channel, play
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.types import FrameReport
from vcmvsp.cosim.vehicle_clock import ClockStep, VehicleClock
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation import broadcast_trial

SLOT_NS, SIZE = 1_000_000, 500
NAMES = ("a", "b", "c")
# c is as far from a as from b: equal levels, so that neither frame survives if both send.
POSITION = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [10.0, 10.0, 0.0]])


def tdma(*, preset: str = "wifi-g-6", clocks: dict[str, VehicleClock] | None = None, **mac: Any) -> Channel:
    channel = make_channel(preset, vehicles=NAMES, mac={"kind": "tdma", "slot_s": SLOT_NS / 1e9, **mac})
    channel.start(1, clocks)
    return channel


def sent_at(channel: Channel, times_ns: Iterable[int], senders: str = "ab") -> list[FrameReport]:
    """Reports of broadcasts: one per sender at each time."""
    return play(channel, NAMES, POSITION, [(time_ns, sender, None) for time_ns in times_ns for sender in senders], SIZE)


def starts_ns(reports: list[FrameReport], sender: str) -> list[int]:
    """Times, ns, at which a sender's frames went on the air."""
    own = [each for each in reports if each.sender == sender]
    return [each.sent_ns + each.queue_ns + each.access_ns for each in own]


# --- slots ---


def test_frames_begin_with_the_slots_of_their_senders() -> None:
    reports = sent_at(tdma(schedule=("a", "", "b", "a")), [100, 200, 300])
    assert starts_ns(reports, "a") == [3 * SLOT_NS, 4 * SLOT_NS, 7 * SLOT_NS]
    assert starts_ns(reports, "b") == [2 * SLOT_NS, 6 * SLOT_NS, 10 * SLOT_NS]


def test_guard_time_delays_the_frame_within_its_slot() -> None:
    reports = sent_at(tdma(schedule=("a", "b"), guard_s=1e-4), [0])
    assert [starts_ns(reports, name) for name in "ab"] == [[100_000], [SLOT_NS + 100_000]]


def test_slots_are_by_the_clock_of_the_vehicle() -> None:
    clocks = {"a": VehicleClock(offset_s=0.25e-3), "b": VehicleClock(drift_ppm=100.0)}
    times_ns = [10**9 + 5 * SLOT_NS * number for number in range(20)]
    reports = sent_at(tdma(clocks=clocks), times_ns)
    for name in "ab":
        own_ns = np.array([clocks[name].mean_ns(time_ns) for time_ns in starts_ns(reports, name)])
        assert np.all((own_ns - "abc".index(name) * SLOT_NS) % (3 * SLOT_NS) <= 1)


@given(
    st.integers(0, 10**15),
    st.floats(-10.0, 10.0),
    st.floats(-1e4, 1e4),
    st.none() | st.builds(ClockStep, at_s=st.floats(0.0, 1e5), by_s=st.floats(-5.0, 5.0)),
)
def test_a_time_of_the_run_is_the_first_at_which_the_clock_shows_it(
    time_ns: int, offset_s: float, drift_ppm: float, step: ClockStep | None
) -> None:
    clock = VehicleClock(offset_s=offset_s, drift_ppm=drift_ppm, step=step)
    shown_ns = clock.mean_ns(time_ns)
    first_ns = clock.time_ns(shown_ns)
    assert first_ns <= time_ns
    assert clock.mean_ns(first_ns) >= shown_ns > clock.mean_ns(first_ns - 2)


def test_a_clock_that_is_set_moves_the_slots() -> None:
    clocks = {"a": VehicleClock(step=ClockStep(at_s=0.0102, by_s=0.0005))}
    reports = sent_at(tdma(schedule=("a", "b"), clocks=clocks), [2 * SLOT_NS * number + 1 for number in range(10)], "a")
    starts = starts_ns(reports, "a")
    assert all(start % (2 * SLOT_NS) == 0 for start in starts if start < 10_200_000)
    assert all(start % (2 * SLOT_NS) == 1_500_000 for start in starts if start > 10_200_000)
    assert len(starts) == 10


# --- losses ---


@pytest.mark.parametrize("preset", ["wifi-g-6", "wifi-b-11", "zigbee", "ideal"])
def test_without_drift_nothing_is_lost_at_full_load(preset: str) -> None:
    """Also with slots as short as the frames: each frame begins as the previous one ends."""
    air_ns = make_channel(preset).phy.air_time_ns(100)
    channel = make_channel(preset, vehicles=("v0", "v1", "v2"), mac={"kind": "tdma", "slot_s": air_ns / 1e9})
    plan = broadcast_trial.TrialTraffic(
        waypoints=broadcast_trial.Waypoints.fixed(POSITION), size_bytes=100, duration_s=1000 * air_ns / 1e9, kind="saturated"
    )
    counts = broadcast_trial.run(channel, plan)
    assert counts["losses"] == {}
    assert counts["frames"] == pytest.approx(1000, abs=4)


def collided(reports: list[FrameReport], sender: str) -> np.ndarray:
    """Whether c lost each frame of a sender to a collision."""
    own = [each for each in reports if each.sender == sender]
    outcomes = [each.outcome[each.receivers.index("c")] for each in own]
    assert set(outcomes) <= {"received", "collision"}
    return np.array([each == "collision" for each in outcomes])


FRAGILE, TIGHT_NS = "wifi-g-54", 200_000  # a modulation that survives no overlap at equal levels, and a slot for it


@pytest.mark.parametrize("guard_s", [0.0, 2e-5])
def test_drift_makes_slots_collide_from_the_closed_form_on(guard_s: float) -> None:
    """Two senders in turn: frames overlap once b's clock is ahead by more than slot less air time."""
    clocks = {"b": VehicleClock(drift_ppm=400.0)}
    channel = tdma(preset=FRAGILE, slot_s=TIGHT_NS / 1e9, schedule=("a", "b"), guard_s=guard_s, clocks=clocks)
    air_ns = channel.phy.air_time_ns(SIZE)
    reports = sent_at(channel, range(0, 5 * 10**8, 2 * TIGHT_NS))
    first_s = np.array(starts_ns(reports, "a"))[collided(reports, "a")][0] / 1e9
    assert first_s == pytest.approx((TIGHT_NS - air_ns) / 400e-6 / 1e9, rel=0.01)


@pytest.mark.parametrize(("preset", "slot_ns"), [(FRAGILE, TIGHT_NS), ("ideal", 20_000)])
def test_the_share_of_collisions_is_air_time_over_slot(preset: str, slot_ns: int) -> None:
    """While b's slots drift across those of a, in a period of two slots, frames overlap during 2 air / (2 slot)."""
    clocks = {"b": VehicleClock(drift_ppm=4000.0)}
    channel = tdma(preset=preset, slot_s=slot_ns / 1e9, schedule=("a", "b"), clocks=clocks)
    passes_ns = round(2 * slot_ns / 4000e-6)  # until the slots of b have drifted by a period
    reports = sent_at(channel, range(0, 4 * passes_ns, 2 * slot_ns))
    assert np.mean(collided(reports, "a")) == pytest.approx(channel.phy.air_time_ns(SIZE) / slot_ns, abs=0.02)


def test_a_radio_that_sends_does_not_receive() -> None:
    channel = tdma(schedule=("a", "b"), clocks={"b": VehicleClock(offset_s=0.0009)})
    reports = sent_at(channel, [2 * SLOT_NS * number for number in range(1, 5)])
    outcomes = {
        (each.sender, name): outcome for each in reports for name, outcome in zip(each.receivers, each.outcome, strict=True)
    }
    assert outcomes["a", "b"] == outcomes["b", "a"] == "receiver transmitting"


# --- runs ---


class Talker(Agent):
    """Sends in each period of 0.1 s."""

    def act(self, obs: Observation, radio: Radio) -> None:
        radio.send(b"", size_bytes=100)


def test_clocks_of_a_scenario_move_its_slots(tmp_path: Path) -> None:
    vehicles = [
        {"name": name, "kind": "p2dx", "position": [5.0 * row, 0.0, 0.0], "clock": {"drift_ppm": 50.0 * row}}
        for row, name in enumerate(NAMES)
    ]
    mac = {"kind": "tdma", "slot_s": 0.002, "schedule": ["c", "b", "a"], "guard_s": 2e-4}
    scenario = {"name": "slots", "duration_s": 5.0, "physics": {"kind": "kinematic"}, "vehicle": vehicles}
    for name in ("first", "again"):
        air = {"preset": "wifi-g-6", "mac": mac}
        result = vcmvsp.run({**scenario, "radio": air}, agents={each: Talker() for each in NAMES}, out=tmp_path / name)
        assert result.metrics["radio"]["losses"] == {}
    rows = pq.read_table(tmp_path / "first" / "radio.parquet").to_pylist()
    for row, name in enumerate(NAMES):
        ends_ns = {each["received_ns"] - each["air_time_ns"] for each in rows if each["sender"] == name}
        own_ns = [VehicleClock(drift_ppm=50.0 * row).mean_ns(each) for each in ends_ns]
        assert {round((each - 200_000 - (2 - row) * 2_000_000) % 6_000_000, -1) % 6_000_000 for each in own_ns} == {0}
    assert (tmp_path / "first" / "run.mcap").read_bytes() == (tmp_path / "again" / "run.mcap").read_bytes()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["radio.mac.slot_s=0.001", 'radio.mac.schedule=["car9"]'], "unknown vehicle 'car9'"),
        (["radio.mac.slot_s=0.001", "radio.mac.guard_s=0.0005"], "must be less than half of slot_s"),
        ([], "slot_s"),
    ],
)
def test_schedules_that_cannot_be_are_refused_in_one_line(settings: list[str], words: str) -> None:
    pairs = ["radio.preset=wifi-g-6", "radio.mac.kind=tdma", *settings]
    result = vcmvsp_command("check", "formation-circle", *(word for each in pairs for word in ("--set", each)))
    assert result.code == 2, json.dumps(result.out)
    assert words in result.err
    assert result.err.count("\n") == 1


@pytest.mark.processes
def test_a_message_that_fits_in_no_slot_ends_the_run_in_one_line(tmp_path: Path) -> None:
    settings = ("radio.preset=wifi-g-6", "radio.mac.kind=tdma", "radio.mac.slot_s=0.0001")
    words = (word for each in settings for word in ("--set", each))
    result = vcmvsp_command("run", "formation-circle", "--quiet", "--out", str(tmp_path / "run"), *words)
    assert result.code == 2
    assert "use longer slots, or shorter messages" in result.err
    assert "Traceback" not in result.err
