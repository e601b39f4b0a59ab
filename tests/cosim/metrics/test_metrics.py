"""Metrics and digest from events with known answers: geometry, hand-made ages, brute force."""

import json
import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import TENTH, Pose, follows, frame, metrics_after, recorder_after, states
from vcmvsp.cosim import types
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.age import links
from vcmvsp.cosim.metrics.motion import min_separation_m, motion
from vcmvsp.cosim.recording import accumulators
from vcmvsp.cosim.recording.accumulators import digest

pytestmark = pytest.mark.slow

L, SIDE, R, W = math.sqrt(3) / 2, 0.5, 2.0, 0.15  # the standard triangle on the standard circle


def on_circle(t: float, side: float, delay_s: float = 0.0) -> dict[str, Pose]:
    """Leader on a circle about the origin, and a follower whose handle L is at its slot of ``delay_s`` ago.

    The handle is at radius R + side, the centre at sqrt((R + side)^2 - L^2), tangent to its circle.
    """
    angle = W * t
    own_radius = math.sqrt((R + side) ** 2 - L**2)
    own = angle - W * delay_s - math.atan2(L, own_radius)
    lead = (R * math.cos(angle), R * math.sin(angle), angle + math.pi / 2)
    return {"lead": lead, "follower": (own_radius * math.cos(own), own_radius * math.sin(own), own + math.pi / 2)}


@given(st.floats(0.0, 5.0), st.sampled_from([SIDE, -SIDE]))
@settings(deadline=None, max_examples=25)
@example(delay_s=0.0, side=SIDE)
@example(delay_s=0.0, side=-SIDE)
def test_delayed_follower_on_a_circle_errs_by_the_chord(delay_s: float, side: float) -> None:
    """|z| = 2 (R + L') sin(w d / 2)."""
    events = [states(TENTH.at(k), on_circle(k / 10, side, delay_s)) for k in range(21)]
    recorder = recorder_after(["lead", "follower"], [follows("follower", "lead", (-L, -side), L), *events], 2 * SECOND_NS)
    formation = recorder.metrics(window=(0.0, None))["formation"]
    chord = 2.0 * (R + side) * math.sin(W * delay_s / 2)
    for name in ("rms_m", "mean_m", "max_m", "final_m"):
        assert formation[name] == pytest.approx(chord, abs=1e-9)
    assert formation["settling_s"] == (0.0 if chord <= 0.05 else None)
    assert formation["per_follower"]["follower"]["rms_m"] == pytest.approx(chord, abs=1e-9)


def displaced_follower(offsets: Sequence[float], ell: float = 0.3) -> list[Event]:
    """A leader that turns on the spot, and a follower off its slot by one offset, m, per tick; |z| is the offset."""
    events = [follows("b", "a", (-1.0, 0.4), ell)]
    for k, offset in enumerate(offsets):
        yaw = 0.3 * k
        c, s = math.cos(yaw), math.sin(yaw)
        events.append(states(TENTH.at(k), {"a": (5.0, -3.0, yaw), "b": (5.0 - c - 0.4 * s + offset, -3.0 - s + 0.4 * c, yaw)}))
    return events


def test_window_counts_both_ends_and_final_and_settling_the_whole_run() -> None:
    offsets = [1.0, 0.8, 0.04, 0.06, 0.03, 0.01, 0.02]
    formation = metrics_after("ab", displaced_follower(offsets), SECOND_NS * 6 // 10, (0.1, 0.3))["formation"]
    assert formation["max_m"] == pytest.approx(0.8)
    assert formation["mean_m"] == pytest.approx((0.8 + 0.04 + 0.06) / 3)
    assert formation["rms_m"] == pytest.approx(math.sqrt((0.8**2 + 0.04**2 + 0.06**2) / 3))
    assert formation["final_m"] == pytest.approx(0.02)
    assert formation["settling_s"] == pytest.approx(0.4)
    assert set(formation["per_follower"]) == {"b"}


def test_a_follower_that_ends_away_from_its_place_never_settles() -> None:
    formation = metrics_after("ab", displaced_follower([0.01, 0.01, 0.06]), SECOND_NS // 5)["formation"]
    assert formation["settling_s"] is None


def test_summary_is_over_all_followers_and_final_is_the_worst_of_them() -> None:
    poses = {"a": (0.0, 0.0, 0.0), "b": (-1.0, 0.3, 0.0), "c": (-2.0, 0.4, 0.0)}
    events = [follows("b", "a", (-1.0, 0.0), 0.5), follows("c", "b", (-1.0, 0.0), 0.5), states(0, poses), states(10**8, poses)]
    formation = metrics_after("abc", events, 10**8)["formation"]
    assert formation["per_follower"]["b"]["rms_m"] == pytest.approx(0.3)
    assert formation["per_follower"]["c"]["rms_m"] == pytest.approx(0.1)
    assert formation["rms_m"] == pytest.approx(math.sqrt((0.3**2 + 0.1**2) / 2))
    assert formation["final_m"] == pytest.approx(0.3)


def test_a_new_slot_counts_from_its_own_time() -> None:
    poses = {"a": (0.0, 0.0, 0.0), "b": (-1.0, 0.0, 0.0), "c": (0.0, 5.0, 0.0)}
    events = [states(TENTH.at(k), poses) for k in range(4)]
    places = [("b", "a", (-1.0, 0.0)), ("b", "c", (-1.0, -5.0)), ("c", "a", (0.0, 4.0))]
    events += [follows(name, leader, slot, 0.2, k * 10**8) for k, (name, leader, slot) in enumerate(places, start=1)]
    formation = metrics_after("abc", events, 3 * 10**8)["formation"]
    assert formation["per_follower"]["b"]["max_m"] == pytest.approx(0.0, abs=1e-12)
    assert formation["per_follower"]["c"]["mean_m"] == pytest.approx(1.0)


def test_following_a_vehicle_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ScenarioError, match="'ghost', which is not a vehicle of this run"):
        recorder_after("ab", [follows("b", "ghost", (0.0, 0.0), 0.3)], 0)


def test_without_followers_radio_or_a_second_vehicle_values_are_null() -> None:
    result = metrics_after("a", [states(0, {"a": (1.0, 2.0, 3.0)})], SECOND_NS, (20.0, None))
    lengths = ("rms_m", "max_m", "final_m")
    link = dict.fromkeys((*lengths, "mean_m", "settling_s", "overshoot", "convergence_1_s", "hop_gain"))
    changes = {"shape_changes": 0, "mode_toggles": None, "avoid_s": None, "reformed_s": None}
    assert result["formation"] == {**link, **changes, "shape": dict.fromkeys(lengths), "per_follower": {}}
    ages = dict.fromkeys(("mean", "p95", "max", "time_average", "peak"))
    assert result["radio"] == {
        "frames": 0, "receptions": 0, "delivery_ratio": None, "under_way": 0, "losses": {},
        "delay_s": dict.fromkeys(("mean", "p50", "p95", "p99", "max")), "age_s": ages,
    }  # fmt: skip
    rms = ("speed_rms_m_s", "yaw_rate_rms_rad_s", "acceleration_rms_m_s2", "yaw_acceleration_rms_rad_s2")
    control = dict.fromkeys((*rms, "effort_m2_s"))
    assert result["control"] == {**control, "per_vehicle": {"a": control}}
    assert result["connectivity"] == dict.fromkeys(("mean", "min", "connected_share"))
    assert result["safety"] == {"collisions": 0, "min_separation_m": None, "min_clearance_m": None}
    parts = ["formation", "radio", "control", "connectivity", "agents", "safety"]
    assert list(result) == ["schema", "scenario", "seed", "duration_s", *parts, "digest"]
    assert (result["schema"], result["scenario"], result["seed"], result["duration_s"]) == ("vcmvsp.metrics/1", "test", 3, 1.0)
    json.dumps(result, allow_nan=False)


def test_radio_counts_and_delays() -> None:
    ms = 1_000_000
    events = [frame(0, "a", 0, {"b": 10 * ms, "c": None}), frame(1, "b", 5 * ms, {"a": 35 * ms, "c": 25 * ms})]
    radio = metrics_after("abc", events, SECOND_NS)["radio"]
    assert (radio["frames"], radio["receptions"], radio["delivery_ratio"]) == (2, 3, 0.75)
    assert radio["losses"] == {"random loss": 1}
    assert radio["delay_s"]["p50"] == pytest.approx(0.020)
    assert radio["delay_s"]["mean"] == pytest.approx(0.020)
    assert radio["delay_s"]["max"] == pytest.approx(0.030)


def test_links_keep_receivers_and_senders_apart() -> None:
    events = [frame(0, "c", 0, {"a": 5, "b": 6}), frame(1, "a", 1, {"b": 9, "c": None}), frame(2, "c", 2, {"a": 4, "b": None})]
    by_pair = links(recorder_after("abc", events, 10).radio)
    received = {key: link.received_ns.tolist() for key, link in by_pair.items()}
    assert received == {("a", "c"): [4, 5], ("b", "a"): [9], ("b", "c"): [6]}
    assert by_pair["a", "c"].sent_ns.tolist() == [2, 2]  # an older message that arrives later lowers no age


@given(st.lists(st.lists(st.tuples(*[st.floats(-50, 50)] * 2), min_size=5, max_size=5), min_size=1, max_size=6))
@settings(deadline=None, max_examples=50)
def test_min_separation_equals_a_plain_loop(instants: list[list[tuple[float, float]]]) -> None:
    events = [
        states(TENTH.at(k), {n: (x, y, 0.0) for n, (x, y) in zip("abcde", points, strict=True)})
        for k, points in enumerate(instants)
    ]
    expected = min(math.dist(points[i], points[j]) for points in instants for i in range(5) for j in range(i))
    found = min_separation_m(motion(recorder_after("abcde", events, TENTH.at(len(instants) - 1)).states))
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_a_vehicle_that_leaves_the_run_has_no_separation() -> None:
    there, alone = {"a": (0.0, 0.0, 0.0), "b": (3.0, 4.0, 0.0)}, {"a": (3.0, 3.9, 0.0)}
    recorder = recorder_after("ab", [states(0, there), states(10**8, alone)], 10**8)
    assert recorder.states.num_rows == 3
    assert recorder.metrics(window=(0.0, None))["safety"]["min_separation_m"] == pytest.approx(5.0)


def test_states_are_kept_at_ticks_and_at_the_end() -> None:
    poses = {"a": (0.0, 0.0, 0.0)}
    events = [states(time, poses) for time in (0, 5 * 10**7, 10**8, 2 * 10**8, 25 * 10**7)]
    assert recorder_after("a", events, 25 * 10**7).states["time_ns"].to_pylist() == [0, 10**8, 2 * 10**8, 25 * 10**7]
    assert recorder_after("a", events, 26 * 10**7).states["time_ns"].to_pylist() == [0, 10**8, 2 * 10**8]


def some_run() -> list[Event]:
    poses = {"a": (1.0, 2.0, 0.5), "b": (3.0, -4.0, 0.1)}
    return [
        states(0, poses),
        follows("b", "a", (-1.0, 0.5), 0.4),
        Event("a/note", 0, types.Note(values={"z1": 0.25, "ok": True, "status": "here"})),
        frame(0, "a", 0, {"b": 1_000_000}),
        frame(1, "b", 0, {"a": None}),
        Event("world/contact", 0, types.Contact(vehicle="a", other="b")),
        states(10**8, poses),
    ]


def digest_of(events: list[Event]) -> str:
    return str(metrics_after("ab", events, 10**8)["digest"])


def changed_values(value: Any) -> list[Any]:
    """All values that differ from ``value`` in one place."""
    if isinstance(value, np.ndarray):
        units = np.eye(value.size, dtype=value.dtype).reshape(value.size, *value.shape)
        return [types.frozen(value + unit) for unit in units]
    if isinstance(value, dict):
        return [{**value, key: other} for key, old in value.items() for other in changed_values(old)]
    if isinstance(value, tuple):
        return [(*value[:i], other, *value[i + 1 :]) for i, old in enumerate(value) for other in changed_values(old)]
    if value is None or value is msgspec.UNSET:
        return []
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int | float):
        return [value + 1]
    if isinstance(value, str):
        return [{"a": "b", "b": "a"}.get(value, value + "!")]
    return [
        msgspec.structs.replace(value, **{f: other})
        for f in value.__struct_fields__
        for other in changed_values(getattr(value, f))
    ]


def test_digest_changes_with_any_single_value() -> None:
    events = some_run()
    digests = [digest_of(events)]
    for i, event in enumerate(events):
        if isinstance(event.value, types.States | types.FrameReport | types.Note | types.Contact | types.Follows):
            for value in changed_values(event.value):
                if isinstance(value, types.Follows) and value.leader == "b":
                    continue  # no vehicle follows itself; the leader's name is covered below
                digests.append(digest_of([*events[:i], Event(event.key, event.time_ns, value), *events[i + 1 :]]))
    assert len(digests) > 80
    assert len(set(digests)) == len(digests)


def test_digest_depends_on_key_time_and_order_and_on_nothing_else() -> None:
    events = some_run()
    note = events[2].value
    other_key = [*events[:2], Event("b/note", 0, note), *events[3:]]
    later = [*events[:2], *events[3:-1], Event("a/note", 1, note), events[-1]]
    swapped = [*events[:2], events[5], *events[3:5], events[2], *events[6:]]
    assert len({digest_of(run) for run in (events, other_key, later, swapped)}) == 4
    assert digest_of(some_run()) == digest_of(events)


@pytest.mark.parametrize(
    "value",
    [
        types.Velocity(linear=(1.0, 0.0, 0.0)),
        types.Waypoint(position=(1.0, 2.0, 3.0)),
        types.Odometry(pose=(0.0, 0.0, 0.0), v=1.0, w=0.0),
        types.Imu(acceleration=(0.0, 0.0, 9.8), angular_velocity=(0.0, 0.0, 0.0)),
        types.Measured(time_ns=0, values={"m": 1.0}),
        types.Fix(time_ns=0, position=(0.0, 0.0, 0.0), sigma_m=0.1),
        types.Scan(ranges=types.frozen([1.0], np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0),
        types.Image(pixels=types.frozen(np.zeros((1, 1, 3)), np.uint8)),
        types.Pushed(names=("box",), position=types.frozen(np.zeros((1, 3))), attitude=types.frozen(np.zeros((1, 4)))),
        types.Message(sender="a", body=b"x", size_bytes=1),
        types.Presence(state="lost", since_ns=0),
        types.RealStatus(link=1, age_s=None),
        types.Incident(what="stopped", cause="x", happened_ns=0),
        types.Outage(vehicles=("a",), until_ns=10**8),
        types.Halted(vehicles=("a",), halted=True),
        types.Moved(obstacle="box", position=(0.0, 0.0), yaw=0.0),
        types.Changed(key="radio.loss.probability", value=0.5),
    ],
    ids=lambda value: type(value).__name__,
)
def test_digest_counts_every_kind_of_event_with_its_time(value: Any) -> None:
    *before, last = some_run()
    runs = [some_run(), *([*before, Event("a/x", time_ns, value), last] for time_ns in (1, 2))]
    assert len(set(map(digest_of, runs))) == 3


def test_digest_ignores_the_size_of_hashed_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    together = digest_of(some_run())
    monkeypatch.setattr(accumulators, "HASHED_BYTES", 0)
    assert digest_of(some_run()) == together


def test_digest_ignores_chunks_and_dictionary_codes() -> None:
    recorder = recorder_after("ab", some_run(), 10**8)
    tables = [recorder.states, recorder.radio]
    plain = digest(tables)
    for table in tables:
        cut = pa.concat_tables([table.slice(0, 1), table.slice(1, 0), table.slice(1)])
        assert cut["frame" if "frame" in cut.column_names else "x"].num_chunks > 1
        recoded = cut
        for i, field in enumerate(cut.schema):
            if pa.types.is_dictionary(field.type):
                names = [str(name) for name in cut.column(i).to_pylist()]
                order = ["unused", *sorted(set(names), reverse=True)]
                codes = pa.array([order.index(name) for name in names], pa.int32())
                recoded = recoded.set_column(
                    i, field, pa.chunked_array([pa.DictionaryArray.from_arrays(codes, pa.array(order))])
                )
        for other in (cut, recoded):
            assert digest([other if old is table else old for old in tables]) == plain
