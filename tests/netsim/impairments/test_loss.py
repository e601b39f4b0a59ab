from functools import partial

import numpy as np
import pytest

from tests.support.netsim.channels import make_frame
from vcmvsp.cosim.rng import key64, link_uniform
from vcmvsp.cosim.types import Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import FixedDelay, NoDelay
from vcmvsp.netsim.impairments.loss import Bernoulli, NoLoss
from vcmvsp.netsim.interfaces.layers import DELAY_SLOT, LOSS_SLOT, Bools, Draw, Frame, LinkDraws, SenderLinks
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.propagation.path_loss import NoPathLoss

FRAMES = np.arange(100_000, dtype=np.uint64)[:, None]
LINKS = np.array([key64(7, f"radio/car1/car{i}") for i in range(2, 10)], np.uint64)


@pytest.fixture(scope="module")
def uniforms() -> np.ndarray:
    """Of 1e5 frames on 8 links."""
    return link_uniform(LINKS, FRAMES, LOSS_SLOT)


def test_nothing_is_lost_without_a_loss_layer() -> None:
    assert not NoLoss().lost(make_frame(5), lambda: np.zeros((5, 2))).any()


@pytest.mark.parametrize("p", [0.01, 0.1, 0.5, 0.9, 0.999])
def test_loss_rate_of_every_link(p: float, uniforms: np.ndarray) -> None:
    """Binomial: within 4.5 standard deviations (once in 18 000 repetitions for the 8 links of one p)."""
    lost = Bernoulli(p).lost(make_frame(*uniforms.shape[:2]), lambda: uniforms)
    assert np.abs(lost.mean(axis=0) - p).max() < 4.5 * np.sqrt(p * (1 - p) / len(FRAMES))


def test_probabilities_0_and_1_are_exact(uniforms: np.ndarray) -> None:
    frame = make_frame(*uniforms.shape[:2])
    assert not Bernoulli(0.0).lost(frame, lambda: uniforms).any()
    assert Bernoulli(1.0).lost(frame, lambda: uniforms).all()
    assert not Bernoulli(0.0).lost(make_frame(4), lambda: np.zeros((4, 2))).any()  # the smallest draw there is


def test_links_frames_and_layers_are_independent(uniforms: np.ndarray) -> None:
    """Correlations of independent series of n values have standard deviation 1 / sqrt(n)."""
    bound = 4.5 / np.sqrt(len(FRAMES))
    lost = Bernoulli(0.3).lost(make_frame(*uniforms.shape[:2]), lambda: uniforms).astype(float)
    between_links = np.corrcoef(lost, rowvar=False) - np.eye(len(LINKS))
    assert np.abs(between_links).max() < bound
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(lost[lag:, 0], lost[:-lag, 0])[0, 1]) < bound
    for_delay = link_uniform(LINKS, FRAMES, DELAY_SLOT)
    assert abs(np.corrcoef(uniforms[:, 0, 0], for_delay[:, 0, 0])[0, 1]) < bound
    assert abs(np.corrcoef(uniforms[:, 0, 0], uniforms[:, 0, 1])[0, 1]) < bound


def test_runs_of_losses_are_geometric(uniforms: np.ndarray) -> None:
    """After a reception, k losses in a row follow with probability p^k: mean p / (1 - p)."""
    p = 0.7
    lost = Bernoulli(p).lost(make_frame(*uniforms.shape[:2]), lambda: uniforms)[:, 0]
    gaps = np.diff(np.flatnonzero(~lost)) - 1
    spread = np.sqrt(p) / (1 - p) / np.sqrt(len(gaps))
    assert abs(gaps.mean() - p / (1 - p)) < 4.5 * spread


@pytest.mark.parametrize("receivers", [1, 9, 300, 5000])
def test_blocks_change_no_draw(receivers: int) -> None:
    """Any order of frames and slots gives what the generator gives for each frame alone."""
    names = tuple(f"car{i}" for i in range(receivers))
    draws = LinkDraws(SenderLinks(3, "leader", names))
    keys = np.array([key64(3, f"radio/leader/{name}") for name in names], np.uint64)
    for frame in (0, 1, 63, 64, 65, 2, 1_000_003, 64, 0):
        for slot in (DELAY_SLOT, LOSS_SLOT):
            alone = link_uniform(keys, np.array(frame, np.uint64), slot)
            assert np.array_equal(draws.uniform(frame, slot), alone)
            some = np.arange(0, receivers, 3)
            assert np.array_equal(draws.some(frame, slot, some), alone[some])
            assert alone.shape == (receivers, 2)


def test_what_goes_by_draws_alone_is_the_same_of_many_frames_at_once() -> None:
    """As frame by frame, in any order, for whichever layer has the slot by now."""
    draws = LinkDraws(SenderLinks(3, "leader", ("a", "b", "c")))
    frame = make_frame(3)
    for number in (0, 1, 255, 256, 2):
        for loss in (Bernoulli(0.3), Bernoulli(0.9)):
            alone = loss.lost(frame, partial(draws.uniform, number, LOSS_SLOT))
            assert np.array_equal(draws.made(number, LOSS_SLOT, loss.lost_by), alone)
        for delay in (FixedDelay(0.05, 0.02), FixedDelay(0.05)):
            late_ns = delay.delay_ns(frame, partial(draws.uniform, number, DELAY_SLOT))
            assert np.array_equal(draws.made(number, DELAY_SLOT, delay.delay_ns_by), late_ns)


def test_a_loss_derived_from_one_that_goes_by_draws_alone_has_its_own_say() -> None:
    class Never(Bernoulli):
        def lost(self, frame: Frame, draw: Draw) -> Bools:
            return np.zeros(frame.rssi_dbm.shape, np.bool_)

    for loss, outcome in ((Bernoulli(1.0), "random loss"), (Never(1.0), "received")):
        channel = Channel(path_loss=NoPathLoss(), phy=Dsss(), loss=loss, delay=NoDelay())
        message = Message(sender="a", body=b"", size_bytes=10)
        (report,) = channel.send(0, message, ("a", "b"), np.zeros((2, 3)))
        assert report.outcome == (outcome,)
