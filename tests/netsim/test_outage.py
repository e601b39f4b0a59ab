import math

import numpy as np
import pytest

from netsim.outage import Outage, Scripted
from tests.netsim.linked import linked_frame

HALF = np.full((3, 2), 0.5)


def struck(outage: Outage, sender: str = "car1", at_s: float = 15.0) -> list[str]:
    frame = linked_frame(sender, *(name for name in ("car1", "car2", "car3", "base") if name != sender), at_s=at_s)
    lost = Scripted((outage,)).lost(frame, lambda: HALF)
    return [name for name, gone in zip(frame.receivers, lost, strict=True) if gone]


def test_from_then_till_then_for_frames_that_touch_it() -> None:
    """The frame is 1 ms long; the outage is [10 s, 20 s)."""
    outage = Outage(from_s=10.0, to_s=20.0)
    times = {9.998: False, 9.999: False, 9.9990001: True, 10.0: True, 19.9999: True, 20.0: False, 30.0: False}
    assert {t: bool(struck(outage, at_s=t)) for t in times} == times


@pytest.mark.parametrize(
    ("links", "sender", "expected"),
    [
        (("**",), "car1", ["car2", "car3", "base"]),
        (("car1/car2",), "car1", ["car2"]),
        (("car1/car2",), "car2", []),
        (("car1/*",), "car1", ["car2", "car3", "base"]),
        (("*/car1",), "car2", ["car1"]),
        (("*/car1",), "car1", []),
        (("car1/car3", "*/base"), "car1", ["car3", "base"]),
        (("nobody/*",), "car1", []),
        ((), "car1", []),
    ],
)
def test_links_by_key_expressions(links: tuple[str, ...], sender: str, expected: list[str]) -> None:
    assert struck(Outage(from_s=0.0, to_s=100.0, links=links), sender) == expected


def test_partial_and_overlapping_outages() -> None:
    """Each strikes independently: 1 - 0.7 x 0.5 of what both concern."""
    layer = Scripted(
        (Outage(from_s=0.0, to_s=9.0, probability=0.3), Outage(from_s=0.0, to_s=9.0, links=("car1/car2",), probability=0.5))
    )
    frame, rng = linked_frame("car1", "car2", "car3", at_s=5.0), np.random.default_rng(1)
    rate = np.mean([layer.lost(frame, lambda: rng.random((2, 2))) for _ in range(20_000)], axis=0)
    assert rate == pytest.approx([0.65, 0.3], abs=4.5 * math.sqrt(0.25 / 20_000))


def test_no_draw_changes_what_is_total_or_absent() -> None:
    frame, most = linked_frame("car1", "car2", "car3", at_s=5.0), 1.0 - 2.0**-53
    total = Scripted((Outage(from_s=0.0, to_s=9.0, links=("car1/car2",)),))
    for draw in (0.0, 0.5, most):
        assert total.lost(frame, lambda draw=draw: np.full((2, 2), draw)).tolist() == [True, False]  # type: ignore[misc]


def test_an_outage_ends_later_than_it_begins() -> None:
    with pytest.raises(ValueError, match=r"to_s = 5: an outage from 5 s must end later"):
        Outage(from_s=5.0, to_s=5.0)
