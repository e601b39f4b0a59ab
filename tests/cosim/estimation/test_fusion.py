"""Fusion of odometry and positions: consistency over seeds, closed forms, late and wrong positions, restarts."""

import math
from collections import deque
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from vcmvsp.cosim.estimation.fusion import FusedPose, Fusion, Verdict
from vcmvsp.cosim.estimation.kalman_filter import (
    SIZE,
    MeasuredPosition,
    OdometryMotion,
    OdometryNoise,
    corrected,
    grown,
    innovation,
    moved,
)
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

MS = 1_000_000
S = 1000 * MS
EXACT = OdometryNoise(distance=0.0, turn=0.0, veer=0.0, time_m=0.0, time_rad=0.0)


class World:
    """A robot that moves as in the filter's model: odometry at 10 Hz with its noise, positions at 5 Hz with ``sigma_m``."""

    def __init__(self, seed: int, sigma_m: float = 0.15, noise: OdometryNoise | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.sigma_m, self.noise = sigma_m, noise or OdometryNoise()
        self.truth = np.zeros(SIZE)
        self.truth[:3] = 3.0, -2.0, self.rng.uniform(-math.pi, math.pi)
        self.time_ns = 0

    def go(self, v: float, w: float) -> tuple[float, float]:
        """Move for 100 ms; distance, m, and turn, rad, of odometry."""
        motion = OdometryMotion(0.1 * v, 0.1 * w, 0.1)
        self.truth, _, added = moved(self.truth, motion, self.noise)
        values, vectors = np.linalg.eigh(added)
        self.truth = self.truth + vectors @ (np.sqrt(np.maximum(values, 0.0)) * self.rng.standard_normal(SIZE))
        self.time_ns += 100 * MS
        return motion.distance_m, motion.turn_rad

    def see(self) -> tuple[float, float]:
        x, y = (self.truth[:2] + self.sigma_m * self.rng.standard_normal(2)).tolist()
        return x, y

    def drive(self, fusion: Fusion, seconds: float, v: float = 0.4, fixes: bool = True) -> Iterator[Verdict | None]:
        """Drive a winding path; for each step the verdict on its position, None without one."""
        if self.time_ns == 0:
            fusion.odometry(0, 0.0, 0.0)
        for step in range(round(seconds * 10)):
            fusion.odometry(*_after(self, v, 0.5 * math.sin(0.05 * step)))
            yield fusion.fix(self.time_ns, *self.see(), self.sigma_m) if fixes and step % 2 == 0 else None

    def go_on(self, fusion: Fusion, seconds: float, v: float = 0.4, fixes: bool = True) -> None:
        """As `drive`, without verdicts."""
        deque(self.drive(fusion, seconds, v, fixes), maxlen=0)

    def error(self, pose: FusedPose) -> Array:
        error: Array = np.array([pose.x, pose.y, pose.heading]) - self.truth[:3]
        error[2] = math.remainder(error[2], math.tau)
        return error


def _pose(fusion: Fusion, now_ns: int) -> FusedPose:
    pose = fusion.estimate(now_ns)
    assert pose is not None
    return pose


def _nees(world: World, pose: FusedPose) -> float:
    error = world.error(pose)
    return float(error @ np.linalg.solve(pose.covariance, error))


def _bounds(degrees: int, runs: int) -> tuple[float, float]:
    """Interval of the mean of ``runs`` chi-square variables, probability 0.999 [Bar-Shalom, Li, Kirubarajan 2001, 5.4]."""
    low, high = chi2.ppf([0.0005, 0.9995], degrees * runs) / runs
    return float(low), float(high)


@pytest.mark.parametrize("known", [True, False])
def test_errors_agree_with_the_covariance(known: bool) -> None:
    runs, nees, nis = 40, [], []
    for seed in range(runs):
        world = World(seed)
        start = tuple((world.truth[:3] + 0.05 * world.rng.standard_normal(3)).tolist())
        fusion = Fusion(start=start if known else None, gate=1.0 - 1e-9)
        verdicts = list(world.drive(fusion, 20.0))
        pose = _pose(fusion, world.time_ns)
        assert pose.heading_known
        nees.append(_nees(world, pose))
        nis += [each.nis for each in verdicts[100:] if each and each.nis is not None]
    low, high = _bounds(3, runs)
    assert low < np.mean(nees) < high
    low, high = _bounds(2, len(nis))
    assert low < np.mean(nis) < high


def test_heading_comes_from_motion() -> None:
    # sigma 0.15 m at 5 Hz, 0.4 m/s: the filter starts after 0.84 m; the heading's error is then 0.18 rad, and after 10 m 0.04
    # rad (200 seeds)
    begun: list[float] = []
    errors = []
    for seed in range(10):
        world, fusion = World(seed), Fusion()
        for step, _ in enumerate(world.drive(fusion, 25.0)):
            if len(begun) == seed and _pose(fusion, world.time_ns).heading_known:
                begun.append(0.04 * (step + 1))
        errors.append(world.error(_pose(fusion, world.time_ns))[2])
    assert max(begun) < 1.0
    assert math.sqrt(np.mean(np.square(errors))) < 0.06


def test_without_motion_the_heading_is_reported_unknown() -> None:
    world, fusion = World(1), Fusion()
    assert fusion.estimate(0) is None
    world.go_on(fusion, 10.0, v=0.0)
    pose = _pose(fusion, world.time_ns)
    assert not pose.heading_known
    assert pose.covariance[2, 2] == pytest.approx(math.pi**2 / 3)  # uniform on the circle
    assert 0.15**2 <= pose.covariance[0, 0] < 1.5 * 0.15**2
    # Without positions, the robot may be anywhere on a circle about the last one
    world.go_on(fusion, 5.0, fixes=False)
    pose = _pose(fusion, world.time_ns)
    assert np.trace(pose.covariance[:2, :2]) > 1.5**2


def test_a_straight_line_with_a_known_heading_is_a_weighted_mean() -> None:
    # Without odometry noise the start is the only unknown: each position minus the distance driven measures it.
    rng = np.random.default_rng(5)
    fusion = Fusion(noise=EXACT, start=(0.0, 0.0, 0.0), start_sigma_m=1.0, start_sigma_rad=1e-9)
    fusion.odometry(0, 0.0, 0.0)
    sums, weight = np.zeros(2), 1.0
    for step in range(1, 51):
        fusion.odometry(step * 100 * MS, 0.05, 0.0)
        sigma = float(rng.uniform(0.1, 0.3))
        x, y = (np.array([0.05 * step, 0.0]) + sigma * rng.standard_normal(2)).tolist()
        assert fusion.fix(step * 100 * MS, x, y, sigma).outcome == "accepted"
        sums += np.array([x - 0.05 * step, y]) / sigma**2
        weight += sigma**-2
    pose = _pose(fusion, 5 * S)
    assert (pose.x, pose.y) == pytest.approx((2.5 + sums[0] / weight, sums[1] / weight), abs=1e-9)
    assert pose.covariance[0, 0] == pytest.approx(1 / weight, rel=1e-9)


def test_a_straight_line_with_an_unknown_heading_is_the_least_squares_fit() -> None:
    # Positions z = c + u R(h): the fit's heading is arg(sum conj(u - mean) (z - mean)), its variance sigma^2 / sum |u - mean|^2
    rng, sigma, heading = np.random.default_rng(6), 0.15, 2.5
    fusion = Fusion(noise=EXACT)
    fusion.odometry(0, 0.0, 0.0)
    u = 0.1 * np.arange(1, 41)
    z = u * np.exp(1j * heading) + sigma * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    for step in range(40):
        fusion.odometry((step + 1) * 100 * MS, 0.1, 0.0)
        fusion.fix((step + 1) * 100 * MS, z[step].real, z[step].imag, sigma)
    pose = _pose(fusion, 4 * S)
    centred = u - u.mean()
    fit = float(np.angle(np.sum(centred * z)))
    spread = float(np.sum(centred**2))
    assert pose.heading == pytest.approx(fit, abs=0.1 * sigma / math.sqrt(spread))  # a tenth of its own sigma: linearised
    assert pose.covariance[2, 2] == pytest.approx(sigma**2 / spread, rel=0.02)
    end = z.mean() + centred[-1] * np.exp(1j * fit)
    assert (pose.x, pose.y) == pytest.approx((end.real, end.imag), abs=0.01)


def test_five_per_cent_of_outliers_do_not_move_it() -> None:
    errors, gated, sent = [], 0, 0
    for seed in range(8):
        world, fusion = World(seed), Fusion()
        fusion.odometry(0, 0.0, 0.0)
        for step in range(400):
            fusion.odometry(*_after(world, 0.4, 0.5 * math.sin(0.05 * step)))
            x, y = world.see()
            if world.rng.random() < 0.05:
                angle = world.rng.uniform(-math.pi, math.pi)
                x, y, sent = x + 3.0 * math.cos(angle), y + 3.0 * math.sin(angle), sent + 1
            fusion.fix(world.time_ns, x, y, 0.15)
            if step >= 100:
                errors.append(math.hypot(*world.error(_pose(fusion, world.time_ns))[:2]))
        pose = _pose(fusion, world.time_ns)
        assert pose.restarts == 0
        gated += pose.gated
    assert gated > 0.6 * sent  # the others came while the heading was unknown
    assert np.percentile(errors, 95) < 0.2
    assert max(errors) < 0.5


def test_drop_outs_of_two_seconds_are_bridged() -> None:
    worst = 0.0
    for seed in range(10):
        world, fusion = World(seed), Fusion()
        world.go_on(fusion, 15.0)
        for _ in range(5):
            before = _pose(fusion, world.time_ns).covariance[0, 0]
            world.go_on(fusion, 2.0, fixes=False)
            pose = _pose(fusion, world.time_ns)
            assert pose.age_s == pytest.approx(2.1, abs=0.11)
            assert pose.covariance[0, 0] > before
            assert _nees(world, pose) < chi2.ppf(0.99999, 3)
            worst = max(worst, math.hypot(*world.error(pose)[:2]))
            world.go_on(fusion, 2.0)
        assert _pose(fusion, world.time_ns).restarts == 0
    assert worst < 0.5


def _log(seed: int) -> tuple[list[tuple[int, float, float]], list[tuple[int, float, float]]]:
    """Odometry (every 100 ms) and positions (at odd times between) of one run."""
    world = World(seed)
    odometry, positions = [(0, 0.0, 0.0)], []
    for step in range(80):
        odometry.append(_after(world, 0.4, 0.5))
        if step % 2 == 0:
            positions.append((world.time_ns - 37 * MS, *world.see()))
    return odometry, positions


def test_late_positions_count_as_timely_ones() -> None:
    odometry, positions = _log(3)
    poses = []
    for delay_ns in (0, 300 * MS, 1500 * MS):
        fusion = Fusion()
        arrivals = [(entry[0], False, entry) for entry in odometry] + [
            (entry[0] + delay_ns, True, entry) for entry in positions
        ]
        for _, is_fix, (time_ns, a, b) in sorted(arrivals):
            if is_fix:
                fusion.fix(time_ns, a, b, 0.15)
            else:
                fusion.odometry(time_ns, a, b)
        assert fusion.late == 0
        poses.append(_pose(fusion, 8 * S))
    for pose in poses[1:]:
        assert (pose.x, pose.y, pose.heading) == (poses[0].x, poses[0].y, poses[0].heading)  # to the bit
        assert np.array_equal(pose.covariance, poses[0].covariance)


@settings(max_examples=10, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_arrival_does_not_matter(random: object) -> None:
    odometry, positions = _log(4)
    positions = [each for t, x, y in positions[:10] for each in ((t, x, y), (t, x + 0.1, y))]  # two positions at each time
    shuffled = list(positions)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    one, other = Fusion(start=(3.0, -2.0, 0.0), start_sigma_rad=2.0), Fusion(start=(3.0, -2.0, 0.0), start_sigma_rad=2.0)
    for fusion, fixes in ((one, positions), (other, shuffled)):
        for entry in odometry[:20]:
            fusion.odometry(*entry)
        for fix in fixes:
            fusion.fix(*fix, 0.15)
    a, b = _pose(one, 2 * S), _pose(other, 2 * S)
    assert (a.x, a.y, a.heading, a.gated) == (b.x, b.y, b.heading, b.gated)


def test_unreported_lateness_costs_the_distance_driven() -> None:
    # Benefit of the source time: without it, 0.3 s at 0.4 m/s are 0.12 m of lag
    lags = []
    for tells in (True, False):
        lag = []
        for seed in range(5):
            world, fusion = World(seed), Fusion()
            fusion.odometry(0, 0.0, 0.0)
            waiting: list[tuple[int, float, float]] = []
            for _ in range(300):
                fusion.odometry(*_after(world))
                waiting.append((world.time_ns, *world.see()))
                if len(waiting) > 3:
                    time_ns, x, y = waiting.pop(0)
                    fusion.fix(time_ns if tells else world.time_ns, x, y, 0.15)
            error = world.error(_pose(fusion, world.time_ns))
            heading = world.truth[2]
            lag.append(error[0] * math.cos(heading) + error[1] * math.sin(heading))
        lags.append(float(np.mean(lag)))
    assert abs(lags[0]) < 0.04
    assert lags[1] == pytest.approx(-0.12, abs=0.04)


def _after(world: World, v: float = 0.4, w: float = 0.0) -> tuple[int, float, float]:
    distance, turn = world.go(v, w)
    return world.time_ns, distance, turn


def test_positions_older_than_the_log_are_refused() -> None:
    fusion = Fusion(start=(0.0, 0.0, 0.0), history_s=1.0)
    for step in range(50):
        fusion.odometry(step * 100 * MS, 0.0, 0.0)
    before = _pose(fusion, 5 * S)
    assert fusion.fix(3 * S, 1.0, 1.0, 0.1).outcome == "late"
    assert fusion.late == 1
    assert _pose(fusion, 5 * S).x == before.x
    assert fusion.fix(4 * S, 0.0, 0.0, 0.1).outcome == "accepted"
    assert len(fusion._nodes) < 15


def test_a_true_jump_restarts_it() -> None:
    for seed in range(10):
        world, fusion = World(seed), Fusion()
        world.go_on(fusion, 10.0)
        world.truth[:3] += 4.0, -3.0, 1.5  # the robot was carried
        verdicts = [each.outcome for each in world.drive(fusion, 2.0) if each]
        assert verdicts[:5] == ["gated"] * 4 + ["restarted"]
        pose = _pose(fusion, world.time_ns)
        assert pose.restarts == 1
        assert math.hypot(*world.error(pose)[:2]) < 1.0
        world.go_on(fusion, 10.0)
        pose = _pose(fusion, world.time_ns)
        assert pose.heading_known
        assert pose.restarts == 1
        assert _nees(world, pose) < chi2.ppf(0.99999, 3)


def test_wrong_positions_that_disagree_restart_nothing() -> None:
    world, fusion = World(2), Fusion()
    world.go_on(fusion, 10.0)
    for _ in range(20):
        fusion.odometry(*_after(world))
        angle = world.rng.uniform(-math.pi, math.pi)
        x, y = world.truth[0] + 5.0 * math.cos(angle), world.truth[1] + 5.0 * math.sin(angle)
        assert fusion.fix(world.time_ns, x, y, 0.15).outcome == "gated"
    assert math.hypot(*world.error(_pose(fusion, world.time_ns))[:2]) < 0.3


def test_gated_positions_are_consecutive_or_restart_nothing() -> None:
    world, fusion = World(2), Fusion()
    world.go_on(fusion, 10.0)
    for step in range(40):  # a constant reflection between correct positions
        fusion.odometry(*_after(world))
        x, y = world.see()
        outcome = fusion.fix(world.time_ns, x + 3.0 * (step % 4 > 0), y, 0.15).outcome
        assert outcome == ("gated" if step % 4 else "accepted")


def test_an_outlier_before_the_heading_is_known_is_left_out() -> None:
    for seed in range(10):
        world, fusion = World(seed), Fusion()
        fusion.odometry(0, 0.0, 0.0)
        for step in range(19):  # 18 correct positions and an outlier; without it the heading is known well enough
            fusion.odometry(*_after(world))
            x, y = world.see()
            fusion.fix(world.time_ns, x + 3.0 * (step == 6), y, 0.15)
        pose = _pose(fusion, world.time_ns)
        assert pose.heading_known
        assert _nees(world, pose) < chi2.ppf(0.9999, 3)


def test_the_log_stays_short_when_positions_stop() -> None:
    world, fusion = World(2), Fusion()
    world.go_on(fusion, 1.0)
    for _ in range(5000):
        fusion.odometry(*_after(world))
    assert len(fusion._nodes) < 25
    assert all(len(node.belief.items) <= 2000 for node in fusion._nodes)
    assert fusion.estimate(world.time_ns) is None or _pose(fusion, world.time_ns).covariance[0, 0] > 1.0


def test_scale_and_veer_are_learnt() -> None:
    # Odometry 5 % too small, unequal wheels; 100 m of bends
    errors = []
    for seed in range(2):
        world = World(seed, noise=OdometryNoise(distance=0.005, veer=0.002, turn=0.01))
        world.truth[3:5] = 0.05, 0.02
        fusion = Fusion(noise=world.noise, scale_sigma=0.1, veer_sigma=0.05)
        world.go_on(fusion, 200.0, v=0.5)
        pose = _pose(fusion, world.time_ns)
        errors.append((pose.scale - 0.05, pose.veer - 0.02))
        assert pose.bias == 0.0
    assert np.abs(errors).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.012)


def test_silence_of_odometry() -> None:
    fusion = Fusion(start=(0.0, 0.0, 0.0), coast_s=0.5)
    fusion.odometry(0, 0.0, 0.0)
    fusion.odometry(S, 1.0, 0.0)
    assert (_pose(fusion, S).x, _pose(fusion, S + 200 * MS).x) == pytest.approx((1.0, 1.2))
    late = _pose(fusion, 5 * S)
    assert late.x == pytest.approx(1.5)
    assert late.v == 0.0
    assert late.covariance[0, 0] > _pose(fusion, 2 * S).covariance[0, 0] > _pose(fusion, S).covariance[0, 0]
    fusion.fix(2 * S, 1.5, 0.0, 100.0)  # a position meanwhile does not spoil later odometry
    fusion.odometry(5 * S, 4.0, 0.0)
    assert _pose(fusion, 5 * S).x == pytest.approx(5.0, abs=1e-3)
    assert _pose(fusion, 5 * S).covariance[0, 0] < late.covariance[0, 0]


def test_before_any_odometry_the_robot_stands() -> None:
    fusion = Fusion(start=(0.0, 0.0, 0.0), history_s=10.0)
    fusion.fix(0, 0.0, 0.0, 1e6)
    fusion.odometry(S, 0.0, 0.0)
    fusion.odometry(2 * S, 1.0, 0.0)
    fusion.fix(S // 2, 0.0, 0.0, 1e6)  # late, from before the first odometry
    assert [_pose(fusion, t * S // 2).x for t in range(5)] == pytest.approx([0.0, 0.0, 0.0, 0.5, 1.0], abs=1e-6)


def test_two_motions_at_one_time_both_count() -> None:
    fusion = Fusion(start=(0.0, 0.0, 0.0))
    for time_ns in (0, S, S, S - 1, 2 * S):
        fusion.odometry(time_ns, 0.5, 0.0)
    assert _pose(fusion, 2 * S).x == pytest.approx(2.0)


def test_invalid_numbers_are_refused() -> None:
    fusion = Fusion()
    with pytest.raises(ValueError, match="finite"):
        fusion.odometry(0, math.nan, 0.0)
    with pytest.raises(ValueError, match="finite"):
        fusion.fix(0, math.inf, 0.0, 0.1)
    with pytest.raises(ValueError, match="positive"):
        fusion.fix(0, 0.0, 0.0, 0.0)


def test_the_noise_of_a_motion() -> None:
    # Turning on the spot, only the heading errs; straight ahead, also the distance, and the position sideways by the heading's
    # error times half the distance
    noise = OdometryNoise(distance=0.02, turn=0.03, veer=0.01, time_m=0.0, time_rad=0.0)
    _, _, spin = moved(np.zeros(SIZE), OdometryMotion(0.0, -2.0, 1.0), noise)
    assert spin[2, 2] == pytest.approx(0.03**2 * 2.0)
    assert np.count_nonzero(spin) == 1
    _, _, straight = moved(np.zeros(SIZE), OdometryMotion(-4.0, 0.0, 1.0), noise)
    assert np.diag(straight)[:3] == pytest.approx([0.02**2 * 4.0, 0.01**2 * 4.0 * 2.0**2, 0.01**2 * 4.0])


small = st.floats(-1.0, 1.0)


@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), small, small, st.floats(0.01, 2.0))
def test_the_jacobian_is_the_derivative(mean: list[float], distance: float, turn: float, seconds: float) -> None:
    at, motion, step = np.array(mean), OdometryMotion(distance, turn, seconds), 1e-6
    _, jacobian, _ = moved(at, motion, EXACT)
    for column in range(SIZE):
        change = step * np.eye(SIZE)[column]
        numeric = (moved(at + change, motion, EXACT)[0] - moved(at - change, motion, EXACT)[0]) / (2 * step)
        assert jacobian[:, column] == pytest.approx(numeric, abs=2e-6)


@given(small, small, st.integers(2, 9))
def test_parts_of_a_motion_add_up(distance: float, turn: float, parts: int) -> None:
    whole, _, added = moved(np.zeros(SIZE), OdometryMotion(distance, turn, 1.0), OdometryNoise())
    mean, covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    for _ in range(parts):
        mean, each, more = moved(mean, OdometryMotion(distance / parts, turn / parts, 1.0 / parts), OdometryNoise())
        covariance = grown(covariance, each, more)
    assert mean == pytest.approx(whole, abs=1e-12)
    # The variances add up; that of the position depends on where along the motion the heading's noise is assumed to act
    assert covariance[2, 2] == pytest.approx(added[2, 2], rel=1e-9)
    assert covariance[:2, :2] == pytest.approx(added[:2, :2], abs=0.35 * added[2, 2] * distance**2 + 1e-5)


entries = st.one_of(
    st.builds(OdometryMotion, st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.floats(0.0, 5.0), st.booleans()),
    st.builds(MeasuredPosition, st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(1e-3, 10.0)),
)


@given(st.lists(entries, max_size=30), st.floats(1e-3, 100.0), st.floats(0.0, 1.0))
def test_the_covariance_stays_symmetric_and_positive(
    log: list[OdometryMotion | MeasuredPosition], first: float, biases: float
) -> None:
    mean = np.zeros(SIZE)
    covariance = np.diag([first**2, first**2, 3.0, biases**2, biases**2, biases**2])
    for entry in log:
        if isinstance(entry, OdometryMotion):
            mean, jacobian, added = moved(mean, entry, OdometryNoise())
            covariance = grown(covariance, jacobian, added)
        else:
            before = np.diag(covariance)
            difference, inverse, nis = innovation(mean, covariance, entry)
            assert nis >= 0.0
            gain, covariance = corrected(covariance, inverse, entry)
            mean = mean + gain @ difference
            assert (np.diag(covariance) <= before * (1 + 1e-9) + 1e-12).all()  # a measurement never increases a variance
        assert np.array_equal(covariance, covariance.T)
        values = np.linalg.eigvalsh(covariance)
        assert values[0] >= -1e-12 * max(values[-1], 1.0)
