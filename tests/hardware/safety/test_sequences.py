"""Random sequences of commands and faults, on the ground and in the air: no law is broken in any order.

``VCMVSP_SEQUENCES=5000 pytest tests/hardware/safety/test_sequences.py`` runs 5000 of each.
"""

import math
import os
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hardware.safety.test_ground_laws import FENCES, limits
from tests.support.hardware.safety_sequences import FAULTS, Rehearsal, Stretch
from vcmvsp.hardware.safety.supervisor import Limits

pytestmark = pytest.mark.slow

SEQUENCES = int(os.environ.get("VCMVSP_SEQUENCES", "150"))

numbers = st.floats(-3.0, 3.0) | st.sampled_from([0.0, 1.0, -1.0, 1e300, -1e308, math.inf, -math.inf, math.nan])
usual = st.floats(-3.0, 3.0) | st.sampled_from([1e6, -1e300])
places = st.tuples(*2 * (st.floats(-3.0, 3.0),), st.floats(-1.5, 1.5))
stretches = st.builds(
    Stretch,
    command=st.tuples(*4 * (usual,)) | st.tuples(*4 * (numbers,)),
    periods=st.integers(1, 8),
    fault=st.just("none") | st.sampled_from(FAULTS),
    where=places,
    anew=st.booleans(),
)


@pytest.mark.timeout(7200 if SEQUENCES > 1000 else 600)
@pytest.mark.parametrize("flies", [False, True], ids=["ground", "air"])
@settings(max_examples=SEQUENCES, deadline=None)
@given(
    fence=st.sampled_from(sorted(FENCES)),
    keep=limits,
    exact=st.booleans(),
    others=st.lists(places, max_size=3),
    margin=st.floats(0.0, 0.2),
    climb=st.floats(0.1, 3.0),
    sequence=st.lists(stretches, min_size=1, max_size=8),
)
def test_no_sequence_breaks_a_law(flies: bool, sequence: list[Stretch], **parameters: Any) -> None:
    Rehearsal(flies, **parameters).run(sequence)


KEEP = Limits(max_speed=1.0, max_yaw_rate=1.0, accel=1.0, decel=1.0, yaw_accel=2.0, yaw_decel=2.0)


@pytest.mark.parametrize("flies", [False, True], ids=["ground", "air"])
@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_stops_it_or_is_none(flies: bool, fault: str) -> None:
    """Otherwise the sequences would not test anything."""
    rehearsal = Rehearsal(flies, "square", KEEP, exact=False)
    rehearsal.run([Stretch((0.5, 0.0, 0.1, 0.2), 12), Stretch((0.5, 0.0, 0.1, 0.2), 12, fault, (0.1, 0.0, 0.0))])
    harmless = ("none", "pose false", "moved", "clock late")
    assert (rehearsal.stops > 0) == (fault not in harmless)
    assert rehearsal.trusted == (fault not in ("pose false", "moved"))


@pytest.mark.parametrize("flies", [False, True], ids=["ground", "air"])
def test_the_check_detects_missing_braking(flies: bool) -> None:
    rehearsal = Rehearsal(flies, "square", KEEP, exact=False)
    move = rehearsal._move
    rehearsal._move = lambda command: move(rehearsal._command((0.5, 0.0, 0.0, 0.0)))  # type: ignore[method-assign]
    with pytest.raises(AssertionError):
        rehearsal.run([Stretch((0.5, 0.0, 0.0, 0.0), 60)])
