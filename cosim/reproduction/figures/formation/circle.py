"""Figures 24 to 26: the triangle on a circle; exact, with inertia, with position noise. And the proof of convergence."""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import (
    AHEAD,
    ASIDE,
    LEFT_BEHIND,
    RIGHT_BEHIND,
    UNLIMITED,
    R,
    T,
    Tracks,
    V,
    W,
    fleet,
    track,
    tracks,
)
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array

NAMES = ("leader", "follower 1", "follower 2")
SIDES = (ASIDE, -ASIDE)
AWAY = ({**RIGHT_BEHIND, "pose": (-1.6, -0.9, 0.4)}, {**LEFT_BEHIND, "pose": (-1.3, 0.9, -0.4)})  # from their slots
GAIN, SPAN_S = 1.0, 0.5  # of the proof: k1 = k2, 1/s; duration of its runs
PAIRS = 10  # of followers in figure 26
STARTS, PARTS = 200, 4  # number of its starts, and of runs that share them


def fig_24(runner: Runner) -> Figure:
    """Figure 24: the triangle on a circle of 2 m; all errors converge to zero, and circles match the closed forms."""
    short = [{**place, "handle": 0.3} for place in (RIGHT_BEHIND, LEFT_BEHIND)]
    steady, handle, *proofs = runner(
        [track(fleet(90.0, AWAY)), track(fleet(90.0, short)), *(_proof(part) for part in range(PARTS))]
    )
    rows = [absolute("|z| after 90 s, m", 0.0, steady.error[-1].max(), 1e-6), *_on_circle(steady)]
    for number, side in enumerate(SIDES):
        expected = closed_forms.circle_distance(R, V, side, AHEAD, 0.3)
        rows.append(absolute(f"rho of follower {number + 1} with handle 0.3 m, m", expected, _rho(handle)[number], 1e-4))
    time_s, v2 = proofs[0][0], np.concatenate([each[1] for each in proofs], axis=1)
    decay = np.exp(-GAIN * time_s)[:, np.newaxis]
    off = np.abs(np.sqrt(v2 / v2[0]) / decay - 1.0).max()
    rows += [
        at_most(
            "proof: 200 random starts at T = 1 ms, largest rise of V in a period, m2", 1e-9, 0.5 * np.diff(v2, axis=0).max()
        ),
        absolute("proof: |z| over |z(0)| exp(-k t), largest share off", 0.0, off, 1e-3),
    ]
    picked = np.linspace(0, v2.shape[1] - 1, 40).astype(int)
    lines = [Curve(time_s, np.sqrt(v2[:, i]), "40 of 200 random starts", 1, "thin") for i in picked]
    proof = Panel(
        "Proof, T = 1 ms, k1 = k2 = 1 1/s",
        "time [s]",
        "|z| [m]",
        [*lines, Curve(time_s, 2.0 * decay[:, 0], "2 m exp(-k t)", 2, "dashed")],
        log_y=True,
    )
    return Figure("Fig. 24: leader-follower triangle on a circle of 2 m", [*_panels(steady), proof], rows, columns=3)


def fig_25(runner: Runner) -> Figure:
    """Figure 25: limited accelerations and lags; commands are constant on a circle, so no error remains."""
    (steady,) = runner([track(fleet(90.0, AWAY, kind="inertial"))])
    late = steady.error[steady.time_s >= 60.0]
    rows = [at_most("|z| from 60 s on, m", 1e-3, late.max()), *_on_circle(steady, 1e-3)]
    return Figure("Fig. 25: the triangle on a circle of 2 m, inertial vehicles", _panels(steady), rows)


def fig_26(runner: Runner) -> Figure:
    """Figure 26: all poses come from positioning, with independent errors of every fix."""
    rows, runs = [], []
    noises = ((0.15, 0.05, (0.06, 0.01), (0.03, 0.005)), (0.05, 0.02, (0.018, 0.002), (0.008, 0.0015)))
    jobs = []
    for sigma_m, sigma_rad, _, _ in noises:
        sensor = {"rate_hz": 10.0, "sigma_m": sigma_m, "sigma_rad": sigma_rad}
        vehicles = {"pose_source": "positioning", "positioning": sensor}
        jobs.append(track(fleet(120.0, [RIGHT_BEHIND, LEFT_BEHIND] * PAIRS, vehicles=vehicles), seed=1))
    runs = runner(jobs)
    for (sigma_m, sigma_rad, rms, spread), each in zip(noises, runs, strict=True):
        late = each.time_s >= 20.0
        case = f"sigma {sigma_m:g} m, {sigma_rad:g} rad"
        radial = _radius(each)[late]
        rows += [
            absolute(f"{case}: RMS |z| of {2 * PAIRS} followers, m", rms[0], np.sqrt((each.error[late] ** 2).mean()), rms[1]),
            absolute(f"{case}: radial deviation of followers, m", spread[0], radial[:, 1:].std(axis=0).mean(), spread[1]),
            absolute(f"{case}: leader off its circle, m", 0.0, np.abs(radial[:, 0] - R).max(), 1e-9),
        ]
    first = Tracks(runs[0].time_s, runs[0].pose[:, :3], runs[0].z[:, :2])
    return Figure(
        "Fig. 26: the triangle on a circle of 2 m, positioning noise of 0.15 m and 0.05 rad", _panels(first, log=False), rows
    )


def _panels(track: Tracks, *, log: bool = True) -> list[Panel]:
    paths = [Curve(track.pose[:, i, 0], track.pose[:, i, 1], name, i, "pose") for i, name in enumerate(NAMES)]
    errors = [Curve(track.time_s, track.error[:, i], name, i + 1) for i, name in enumerate(NAMES[1:])]
    return [
        Panel("Tracks; follower 1 at +30°, 2 at -30°", "x east [m]", "y north [m]", paths, equal=True),
        Panel("Formation error", "time [s]", "|z| [m]", errors, log_y=log, y_limits=(1e-9, 2.0) if log else None),
    ]


def _radius(track: Tracks) -> Array:
    """Distance of all vehicles to the centre of the leader's final circle, (m, vehicles)."""
    x, y, yaw = track.pose[-1, 0]
    return np.asarray(np.hypot(track.pose[..., 0] - x + R * math.sin(yaw), track.pose[..., 1] - y - R * math.cos(yaw)))


def _rho(track: Tracks) -> Array:
    """Final distance of the followers to their leader, m."""
    return np.asarray(np.hypot(*(track.pose[-1, 1:, :2] - track.pose[-1, :1, :2]).T))


def _on_circle(track: Tracks, tolerance: float = 1e-5) -> Iterator[Row]:
    """Rows for radius, distance and speed of both followers at the end, against the closed forms."""
    chord = np.hypot(*(track.pose[-1, 1:, :2] - track.pose[-2, 1:, :2]).T)
    speed = chord / (T * np.sinc(W * T / 2.0 / math.pi))  # along the arc
    for number, side in enumerate(SIDES):
        radius, rho, v = closed_forms.circle(R, V, side, AHEAD)
        of = f"of follower {number + 1}"
        yield absolute(f"radius {of}, m", radius, _radius(track)[-1, number + 1], tolerance)
        yield absolute(f"rho {of}, m", rho, _rho(track)[number], tolerance)
        yield absolute(f"speed {of}, m/s", v, speed[number], tolerance)


def _proof(part: int) -> Job:
    """A run with a share of the random starts, at T = 1 ms, behind a leader with its own yaw rate."""
    draws = np.random.Generator(np.random.PCG64(part))
    rate, middle = (-0.15, -0.05, 0.05, 0.15)[part], np.array([-AHEAD, 0.0])
    followers = [
        {
            **(RIGHT_BEHIND, LEFT_BEHIND)[number % 2],
            **UNLIMITED,
            "k1": GAIN,
            "k2": GAIN,
            "pose": (*(middle + draws.uniform(-1.0, 1.0, 2)).tolist(), float(draws.uniform(-math.pi, math.pi))),
        }
        for number in range(STARTS // PARTS)
    ]
    scenario = fleet(SPAN_S, followers, leader={"yaw_rate": rate}, agents={"period_s": 0.001}, record={"period_s": 0.001})
    return Job(scenario, partial(_squares, scenario=scenario))


def _squares(result: Result, scenario: dict[str, object]) -> tuple[Array, Array]:
    """Times from the first report on, s, and |z|^2 (m, followers), m2, equal to 2 V."""
    track = tracks(result, scenario)
    return track.time_s[1:] - track.time_s[1], track.error[1:] ** 2
