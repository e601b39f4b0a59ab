"""Frame counts of a recording at any time, with any number of frames between two stored sums."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.view.player import collected
from vcmvsp.cosim.view.player.collected import Counts

NAMES = ("a", "b", "c")
OTHERS = {"a": ("b", "c"), "b": ("c",), "c": ("b", "a")}
FRAMES = st.lists(st.tuples(st.integers(0, 3), st.sampled_from(NAMES), st.tuples(st.booleans(), st.booleans())), max_size=60)


@pytest.fixture(scope="module", autouse=True)
def _sums_are_kept_often() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collected, "ROWS_BETWEEN", 1)
        yield


@given(FRAMES, st.integers(-1, 200), st.integers(-1, 200))
def test_counts_cover_the_frames_so_far(frames: list[tuple[int, str, tuple[bool, bool]]], time_ns: int, since_ns: int) -> None:
    counts, sent, received = Counts(NAMES), np.zeros((3, 3), int), np.zeros((3, 3), int)
    now_ns, newest = 0, {}
    for number, (wait_ns, sender, arrived) in enumerate(frames):
        now_ns += wait_ns
        arrivals = list(zip(OTHERS[sender], arrived, strict=False))
        received_ns = [now_ns if each else -1 for _, each in arrivals]
        frame = {"sender": sender, "receivers": OTHERS[sender], "received_ns": received_ns, "rssi_dbm": [-60.0] * len(arrivals)}
        counts.take(now_ns, json.dumps(frame).encode())
        if now_ns <= time_ns:
            for receiver, each in arrivals:
                sent[NAMES.index(sender), NAMES.index(receiver)] += 1
                received[NAMES.index(sender), NAMES.index(receiver)] += each
            if now_ns > since_ns:
                newest[sender] = number
    counts.close()
    np.testing.assert_array_equal(counts.at(time_ns), (sent, received))
    assert counts.newest(counts.frames(since_ns), counts.frames(time_ns)) == sorted(newest.values())
