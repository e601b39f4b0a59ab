"""Runtime changes of the radio: disconnected vehicles and changed values; all else is as without them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.netsim.channels import at_rest, linked_frame, make_channel, plain_channel
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.tables.schema import RunFacts, radio_table, write_table
from vcmvsp.cosim.types import Changed, FrameReport, Message, Outage, Probability
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.channel.channel import RuntimeChanges
from vcmvsp.netsim.channel.replayed import RecordedFrames
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.impairments.delay import FixedDelay, GammaDelay, UniformDelay
from vcmvsp.netsim.impairments.loss import Bernoulli, Bursts, NoLoss
from vcmvsp.netsim.impairments.script import Change, Script
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Frame

pytestmark = pytest.mark.slow

MS = 1_000_000
NAMES = ("car1", "car2", "car3", "base")
RUN = RunInfo(scenario="test", seed=4, duration_ns=10**10, vehicles=NAMES)
CHANCE: dict[str, Any] = {
    "loss": {"probability": 0.3},
    "delay": {"seconds": 0.02, "jitter_s": 0.01},
    "fading": {"kind": "nakagami", "m": 1.5},
}
MACS = pytest.mark.parametrize(("preset", "mac"), [("wifi-b-1", "ideal"), ("wifi-b-1", "dcf"), ("zigbee", "csma154")])
OFFERS = st.lists(
    st.tuples(st.integers(0, 60_000), st.sampled_from(NAMES), st.sampled_from((None, *NAMES))), min_size=1, max_size=30
)


def where() -> Event:
    return Event("world/states", 0, at_rest(NAMES, [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 50.0, 0.0), (70.0, 0.0, 0.0)]))


def sends(offers: Sequence[tuple[int, str, str | None]]) -> list[Event]:
    """Frames at these times, us."""
    return [
        Event(f"{sender}/send", at_us * 1000, Message(sender=sender, body={}, size_bytes=80, to=None if to == sender else to))
        for at_us, sender, to in sorted(offers, key=lambda each: each[:2])
    ]


def outage(at_ns: int, until_ns: int, *vehicles: str) -> Event:
    return Event("operator/outage", at_ns, Outage(vehicles=vehicles, until_ns=until_ns))


def changed(at_ns: int, key: str, value: float) -> Event:
    return Event("operator/changed", at_ns, Changed(key=key, value=value))


def fates(
    radio: RadioFederate, events: Sequence[Event], cuts: Sequence[int] = (), *, use_next: bool = True
) -> list[FrameReport]:
    """Every report of a run, by frames: stepped at transmissions, at requested times, and at further times, ns.

    Changes are applied at the next step, as by the kernel.
    """
    radio.start(RUN)
    waiting = [where(), *sorted(events, key=lambda each: (each.time_ns, isinstance(each.value, Message)))]
    times = sorted({*(each.time_ns for each in events if isinstance(each.value, Message)), *cuts, RUN.duration_ns})
    found, due = [], None
    while times or due is not None:
        now = min(each for each in (due, *times[:1]) if each is not None)
        times = times[1:] if times[:1] == [now] else times
        inbox = [each for each in waiting if each.time_ns <= now]
        waiting = waiting[len(inbox) :]
        step = radio.step(now, inbox)
        found += [event.value for event in step.events if isinstance(event.value, FrameReport)]
        due = step.next_ns if use_next else None
    return sorted(found, key=lambda each: each.frame)


@given(
    cuts=st.lists(st.tuples(st.sets(st.sampled_from(NAMES), min_size=1), st.integers(0, 8), st.integers(1, 4)), max_size=3),
    sender=st.sampled_from(NAMES),
    start=st.integers(-1, 10),
    air=st.integers(1, 4),
)
def test_outages_equal_a_script_with_the_same_changes(
    cuts: list[tuple[set[str], int, int]], sender: str, start: int, air: int
) -> None:
    operated, changes = RuntimeChanges(), list[Change]()
    for vehicles, begin, length in cuts:
        operated.cut_off(sorted(vehicles), begin * MS, (begin + length) * MS)
        links = tuple(link for name in vehicles for link in (f"{name}/*", f"*/{name}"))
        changes.append(Change(from_s=begin / 1e3, to_s=(begin + length) / 1e3, links=links, loss=1.0))
    frame = linked_frame(sender, *[each for each in NAMES if each != sender], at_s=start / 1e3, air_ns=air * MS)
    outages, scripted = (each.lost(frame, lambda: np.full((3, 2), 0.5)) for each in (operated.outages, Script((*changes,))))
    assert outages.tolist() == scripted.tolist()


def radio(preset: str = "wifi-b-1", mac: str = "ideal", **changes: Any) -> RadioFederate:
    return RadioFederate(make_channel(preset, mac={"kind": mac}, **CHANCE | changes))


def bare(report: FrameReport, at: int) -> Any:
    """Report for one receiver, without its frame."""
    return encode([getattr(report, name)[at] for name in ("received_ns", "outcome", "rssi_dbm", "sinr_db")])


@MACS
@settings(max_examples=12)
@given(
    offers=OFFERS,
    begin=st.integers(0, 60_000),
    length=st.integers(1, 40_000),
    vehicles=st.sets(st.sampled_from(NAMES), min_size=1),
)
def test_nothing_passes_in_an_outage_and_all_else_fares_as_without_it(
    preset: str, mac: str, offers: list[tuple[int, str, str | None]], begin: int, length: int, vehicles: set[str]
) -> None:
    begin_ns, end_ns = begin * 1000, (begin + length) * 1000
    without = fates(radio(preset, mac), sends(offers))
    with_it = fates(radio(preset, mac), [*sends(offers), outage(begin_ns, end_ns, *sorted(vehicles))])
    assert len(without) == len(with_it) == len(offers)
    for plain, cut in zip(without, with_it, strict=True):
        start = plain.sent_ns + plain.queue_ns + plain.access_ns
        decided_ns = plain.sent_ns if mac == "ideal" else start + plain.air_time_ns
        overlaps = start < end_ns and start + plain.air_time_ns > begin_ns and decided_ns >= begin_ns
        for at, receiver in enumerate(plain.receivers):
            if not (overlaps and vehicles & {plain.sender, receiver}):
                assert bare(cut, at) == bare(plain, at)
                continue
            assert cut.received_ns[at] == -1
            behind = plain.outcome[at] in ("received", "random loss")  # losses on the air are reported as ever
            assert cut.outcome[at] == ("outage" if behind else plain.outcome[at])


@MACS
@pytest.mark.parametrize(
    ("key", "value", "tables"),
    [
        ("radio.loss.probability", 0.8, {"loss": {"probability": 0.8}}),
        ("radio.loss.probability", 0.0, {"loss": {"probability": 0.0}}),
        ("radio.delay.seconds", 0.1, {"delay": {"seconds": 0.1, "jitter_s": 0.01}}),
        ("radio.delay.jitter_s", 0.0, {"delay": {"seconds": 0.02}}),
    ],
)
def test_after_a_change_a_run_equals_one_that_always_had_the_value(
    preset: str, mac: str, key: str, value: float, tables: dict[str, Any]
) -> None:
    """Draws belong to frames: earlier frames fare as without the change, later ones as with the new value from 0 on."""
    rng, at_ns = np.random.default_rng(1), 251 * MS + 7
    offers = [(int(t), NAMES[s], None) for t, s in zip(rng.integers(0, 500_000, 120), rng.integers(0, 4, 120), strict=True)]
    one = fates(radio(preset, mac), sends(offers))
    other = fates(radio(preset, mac, **tables), sends(offers))
    both = fates(radio(preset, mac), [*sends(offers), changed(at_ns, key, value)])

    waits = [0 if mac == "ideal" else each.queue_ns + each.access_ns + each.air_time_ns for each in one]
    before = [each.sent_ns + wait_ns < at_ns for each, wait_ns in zip(one, waits, strict=True)]
    assert encode(both) == encode([a if first else b for a, b, first in zip(one, other, before, strict=True)])
    assert encode(one) != encode(both) != encode(other)


@MACS
@settings(max_examples=8)
@given(offers=OFFERS, cuts=st.lists(st.integers(0, 90_000_000), max_size=8))
def test_changes_apply_at_their_time_whenever_the_radio_hears_of_them(
    preset: str, mac: str, offers: list[tuple[int, str, str | None]], cuts: list[int]
) -> None:
    changes = [outage(11 * MS + 1, 23 * MS, "car2"), changed(20 * MS, "radio.loss.probability", 0.9)]
    changes.append(changed(31 * MS + 5, "radio.delay.seconds", 0.05))
    events = [*sends(offers), *changes]
    whole = fates(radio(preset, mac), events)
    assert encode(fates(radio(preset, mac), events, cuts)) == encode(whole)
    assert encode(fates(radio(preset, mac), events, use_next=False)) == encode(whole)  # not even when it has something to send


def test_layers_go_by_their_names_in_whatever_order_they_stand() -> None:
    channel = make_channel("ideal", loss={"kind": "bernoulli", "probability": 1.0})
    channel.operated.layers = dict(reversed(list(channel.operated.layers.items())))
    channel.change("radio.delay.seconds", 0.5)
    (report,) = channel.send(0, Message(sender="a", body=b"", size_bytes=100), ("a", "b"), np.zeros((2, 3)))
    assert report.outcome == ("random loss",)


def test_a_restart_drops_all_changes() -> None:
    offers = [(k * 1000, "car1", None) for k in range(50)]
    used, changes = radio(), [outage(0, 20 * MS, "car1"), changed(0, "radio.loss.probability", 1.0)]
    outcomes = {each for report in fates(used, [*sends(offers), *changes]) for each in report.outcome}
    assert outcomes <= {"outage", "random loss", "fading"}
    assert used.adjustable()["radio.loss.probability"] == 1.0
    assert encode(fates(used, sends(offers))) == encode(fates(radio(), sends(offers)))
    assert used.adjustable()["radio.loss.probability"] == 0.3


def test_recorded_frames_fare_as_recorded(tmp_path: Path) -> None:
    offers = [(k * 1000, "car1", None) for k in range(50)]
    changes = [outage(10 * MS, 20 * MS, "car1"), changed(30 * MS, "radio.loss.probability", 1.0)]
    then = fates(radio(), [*sends(offers), *changes])
    write_table(radio_table(then, RunFacts(scenario="t", seed=4, end_ns=10**9, vehicles=NAMES)), tmp_path / "radio.parquet")
    channel = make_channel("wifi-b-1", **CHANCE)
    channel.recorded = RecordedFrames(tmp_path / "radio.parquet")
    again = RadioFederate(channel)
    now = fates(again, [*sends(offers), outage(0, 10**9, "base")])
    assert [each.outcome for each in now] == [each.outcome for each in then]
    again.check_change("radio.loss.probability", 0.5)


@dataclass(frozen=True)
class Rain(NoLoss):
    """A user-written layer."""

    share: Probability
    drops: int = 3
    name: str = "drizzle"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        return np.asarray(draw()[..., 0] < self.share)


class Snow(NoLoss):
    """A user-written layer that does not store its configuration."""

    def __init__(self, share: float) -> None:
        self.share = share


def layered(**layers: Any) -> RadioFederate:
    return RadioFederate(plain_channel(**layers))


@pytest.mark.parametrize(
    ("made", "keys"),
    [
        (layered(loss=Bernoulli(0.2)), {"loss.probability": 0.2}),
        (layered(delay=FixedDelay(0.1)), {"delay.seconds": 0.1, "delay.jitter_s": 0.0}),
        (layered(delay=UniformDelay(0.1, 0.2)), {"delay.from_s": 0.1, "delay.to_s": 0.2}),
        (layered(loss=Bursts()), {"loss.probability": 0.2, "loss.mean_burst_s": 1.0}),
        (layered(loss=Rain(0.5)), {"loss.share": 0.5, "loss.drops": 3}),
        (layered(loss=Snow(0.5)), {}),
    ],
)
def test_only_values_of_existing_layers_may_change(made: RadioFederate, keys: dict[str, float]) -> None:
    assert made.adjustable() == {f"radio.{key}": value for key, value in keys.items()}
    for key, value in made.adjustable().items():
        made.check_change(key, value)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("radio.loss.probability", 1.5, "radio.loss.probability: must be a number >= 0 and <= 1, not 1.5"),
        ("radio.loss.probability", math.nan, "radio.loss.probability: must be finite, not nan"),
        ("radio.delay.mean_s", 10.0, "radio.delay.sigma_s: must be between 1/32 and 3 times mean_s = 10, and above 0"),
        (
            "radio.phy.rate_bps",
            1e6,
            "radio.phy.rate_bps cannot change during a run; keys that can: "
            "radio.loss.probability, radio.delay.mean_s, radio.delay.sigma_s, radio.delay.fixed_s",
        ),
        ("loss", 0.1, "loss cannot change during a run; keys that can: radio.loss"),
    ],
)
def test_bad_changes_are_refused_and_change_nothing(key: str, value: float, words: str) -> None:
    made = layered(loss=Bernoulli(0.1), delay=GammaDelay(0.05, 0.02))
    before = made.adjustable()
    with pytest.raises(ValueError, match=r".") as raised:
        made.check_change(key, value)
    assert str(raised.value).startswith(words)
    assert made.adjustable() == before


def test_a_change_is_validated_after_earlier_ones() -> None:
    made = layered(delay=UniformDelay(0.01, 0.05))
    with pytest.raises(ValueError, match=r"must not be less than from_s = 0\.1"):
        made.check_change("radio.delay.from_s", 0.1)
    made.check_change("radio.delay.from_s", 0.1, [("radio.delay.to_s", 0.2)])
