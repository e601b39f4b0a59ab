"""Figures of a run from its tables: `trajectory` seen from above and `formation_error` over time."""

from collections.abc import Collection, Mapping, Sequence
from functools import partial

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.path import Path

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.age import links
from vcmvsp.cosim.metrics.formation import ROUNDING_M, SETTLED_M, formation_errors
from vcmvsp.cosim.metrics.motion import Motion, Window, followers, motion
from vcmvsp.cosim.metrics.routing import COLUMNS, unreached_s
from vcmvsp.cosim.plots.style import ABOVE, GREY, LEVEL, line_of, styled
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.tables.schema import NOT_LOST, Placement, Table, selected
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.palette import color_of

COMPARED_S = 15.0  # end of the tracks that a comparison shows
SNAPSHOTS = 5  # instants at which the formation is drawn, including start and end
OF_RADIO = ("sender", "receiver", "outcome", "sent_ns", "received_ns", *COLUMNS)
"""Columns of the radio's table that figures need."""
LISTED = 15  # vehicles in a legend
EXPLAINED = START, WAY, LINE, SETTLED, EVALUATED = (
    "start",
    "on the way, end",
    "follower to leader",
    "settled: 5 cm",
    "evaluated",
)
"""Entries of legends that are no vehicles."""
ANTENNA = Path([(0, 0), (0, 2), (-1, 2), (0, 1), (1, 2), (0, 2)], [1, 2, 1, 2, 2, 2])  # mark of a station, with its foot there
NAMED = 8  # rows of lost messages, one text line high each; with more, they have no names


@styled
def trajectory(
    states: Table, follows: Sequence[Placement] = (), outlines: Sequence[Array] = (), stations: Collection[str] = ()
) -> Figure:
    """Tracks of the vehicles seen from above: a marker at each start, arrowheads on the way, a larger one at the end.

    A station is the mark of an antenna.

    At a few instants thin lines from followers to leaders show the shape of the formation. ``outlines``, (k, 2) m each, are
    those of solids.
    """
    moved = motion(states)
    x, y, _ = moved.position
    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    figure.suptitle("Where the vehicles went")
    axes = figure.add_subplot()
    solids = PolyCollection(outlines, facecolor="0.88", edgecolor="0.72", linewidth=0.5, zorder=1)
    axes.add_collection(solids, autolim=False)  # the tracks determine the axis limits
    last = len(moved.time_ns) - 1
    instants: list[int] = np.unique(np.linspace(0, last, SNAPSHOTS).round().astype(int)).tolist() if last > 0 else []
    for instant in instants:
        _draw_formation(axes, moved, follows, instant)
    for i, name in enumerate(moved.names):
        if name in stations:
            axes.plot(
                x[:1, i], y[:1, i], color=color_of(i), linestyle="", marker=ANTENNA, markersize=14.0, label=name, zorder=4
            )
            continue
        axes.plot(x[:, i], y[:, i], **{**line_of(i), "markevery": [0]}, label=name, zorder=3)
        for instant in instants[1:]:
            pose = x[instant, i], y[instant, i], moved.yaw[instant, i]
            draw_vehicle(axes, pose, color_of(i), 14.0 if instant == instants[-1] else 9.0)
    axes.plot([], [], color=GREY, linestyle="", marker="o", markersize=4.0, label=START)
    axes.plot([], [], color=GREY, linestyle="", marker=">", markersize=6.0, label=WAY)
    if follows:
        axes.plot([], [], color=GREY, linewidth=0.7, label=LINE)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.set_xlabel("x east [m]")
    axes.set_ylabel("y north [m]")
    if moved.names:
        _legend(axes)
    return figure


@styled
def formation_error(states: Table, radio: Table, follows: Sequence[Placement], window: Window | None = None) -> Figure:
    """Formation error of every follower over time; below, with radio, the age of its information on its leader, and losses.

    The evaluation window (s) is shaded; the dashed line is the 5 cm at which a follower has settled.
    """
    moved = motion(states)
    errors = formation_errors(moved, follows)
    if radio.num_rows and errors:
        figure = Figure(figsize=(7.0, 5.0), layout="constrained")
        rows = min(0.3 + 0.12 * len(errors), 1.5)
        above, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(3.0, 1.8, rows))
        _draw_ages(middle, moved, radio, follows, list(errors))
        _draw_losses(below, moved, selected(radio, OF_RADIO), follows, list(errors))
    else:
        figure = Figure(figsize=(7.0, 3.2), layout="constrained")
        above = figure.add_subplot()
        above.set_xlabel("time [s]")
    figure.suptitle("How well the formation is kept")
    time = moved.time_ns / SECOND_NS
    for name, error in errors.items():
        above.plot(time, error, **line_of(moved.column(name)), label=name, zorder=3)
    above.axhline(SETTLED_M, **LEVEL, zorder=2, label=SETTLED)
    above.set_ylabel("formation error |z| [m]")
    _choose_scale(above, list(errors.values()))
    if len(time):
        above.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
    if window is not None and len(time):
        begin, end = window
        above.axvspan(begin, time[-1] if end is None else end, color="0.95", zorder=0, label=EVALUATED)
    if errors:
        _legend(above)
    else:
        above.annotate("no vehicle follows another", (0.5, 0.5), xycoords="axes fraction", ha="center")
    return figure


@styled
def comparison(runs: Mapping[str, tuple[Table, Sequence[Placement]]]) -> Figure:
    """Runs side by side: the last `COMPARED_S` of the tracks seen from above; below, the formation error of each over time.

    Args:
        runs: true states and slots of each run, by its title.
    """
    figure = Figure(figsize=(2.3 * max(2, len(runs)), 4.6), layout="constrained")
    grid = figure.add_gridspec(2, len(runs), height_ratios=(1.3, 1.0))
    above = [figure.add_subplot(grid[0, number]) for number in range(len(runs))]
    below = figure.add_subplot(grid[1, :])
    curves = []
    for number, (axes, (title, (states, follows))) in enumerate(zip(above, runs.items(), strict=True)):
        moved = motion(states)
        time_s = moved.time_ns / SECOND_NS
        last = slice(int(np.searchsorted(time_s, time_s[-1] - COMPARED_S)), None)
        following = followers(moved.names, follows)
        for i, name in enumerate(moved.names):
            x, y, _ = moved.position[:, last, i]
            color = color_of(number) if name in following else GREY
            axes.plot(x, y, color=color, linewidth=0.9, zorder=3)
            draw_vehicle(axes, (x[-1], y[-1], moved.yaw[-1, i]), color, 9.0)
        _draw_formation(axes, moved, follows, len(moved.time_ns) - 1)
        axes.set_title(title)
        axes.set_aspect("equal", adjustable="datalim")
        errors = [*formation_errors(moved, follows).values()]
        if errors:
            curves.append(np.sqrt(np.nanmean(np.square(errors), axis=0)))
            below.plot(time_s, curves[-1], color=color_of(number), label=title)
    above[0].set_ylabel("y north [m]")
    for axes in above:
        axes.set_xlabel("x east [m]")
    _choose_scale(below, curves)
    below.set(xlabel="time [s]", ylabel="formation error,\nRMS of followers [m]", xlim=(0.0, None))
    if curves:
        below.legend(ncols=len(runs), **ABOVE)
    return figure


def draw_vehicle(axes: Axes, pose: tuple[float, float, float], color: str, size: float) -> None:
    """Draw a vehicle as a slender triangle that points ahead, of a size in points, visible at any scale."""
    x, y, yaw = pose
    if np.isnan(yaw):
        return
    triangle = np.array([(1.0, 0.0), (-0.8, 0.55), (-0.8, -0.55), (1.0, 0.0)])
    turn = np.array([(np.cos(yaw), np.sin(yaw)), (-np.sin(yaw), np.cos(yaw))])
    axes.plot(
        x, y, marker=triangle @ turn, color=color, markersize=size, markeredgecolor="white", markeredgewidth=0.6, zorder=5
    )


def _draw_formation(axes: Axes, moved: Motion, follows: Sequence[Placement], instant: int) -> None:
    now = moved.time_ns[instant]
    leader_of = {placement.vehicle: placement.follows.leader for placement in follows if placement.time_ns <= now}
    for follower, leader in leader_of.items():
        if leader is None:
            continue
        pair = [moved.column(follower), moved.column(leader)]
        axes.plot(*moved.position[:2, instant, pair], color=GREY, linewidth=0.7, zorder=2)


def _choose_scale(axes: Axes, errors: list[Array]) -> None:
    values = np.concatenate([np.empty(0), *errors])
    values = values[np.isfinite(values) & (values > 0)]
    if values.max(initial=0.0) > ROUNDING_M and np.percentile(values, 95) > 20 * np.percentile(values, 20):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")  # powers would load and run the parser of formulas
        axes.set_ylim(max(ROUNDING_M, 0.5 * np.percentile(values, 5)), 2.0 * values.max())
    else:
        axes.set_ylim(0.0, 1.05 * max(values.max(initial=0.0), 1.2 * SETTLED_M))


def _draw_ages(axes: Axes, moved: Motion, radio: Table, follows: Sequence[Placement], followers: list[str]) -> None:
    histories = links(radio, {(name, leader) for name in followers for leader in _leaders(name, follows)})
    for name in followers:
        for leader in _leaders(name, follows):
            if (name, leader) in histories:
                at = moved.time_ns[np.searchsorted(moved.time_ns, histories[name, leader].received_ns[0]) :]
                age = histories[name, leader].age_ns(at) / SECOND_NS
                axes.plot(at / SECOND_NS, age, **{**line_of(moved.column(name)), "marker": ""}, linewidth=0.9, zorder=3)
    axes.set_ylabel("age of\ninformation [s]")
    axes.set_ylim(bottom=0.0)


def _draw_losses(axes: Axes, moved: Motion, radio: pa.Table, follows: Sequence[Placement], followers: list[str]) -> None:
    lost = [np.concatenate([*map(partial(_lost_s, radio, name), _leaders(name, follows))]) for name in followers]
    colors = [color_of(moved.column(name)) for name in followers]
    if followers:
        axes.eventplot(lost, colors=colors, lineoffsets=list(range(len(lost))), linelengths=0.75, linewidths=0.7)
    axes.set_ylim(len(lost) - 0.5, -0.5)
    labels = followers if len(followers) <= NAMED else []
    axes.set_yticks(range(len(labels)), labels, fontsize="small")
    axes.tick_params(axis="y", length=0.0)
    axes.grid(visible=False)
    axes.spines["left"].set_visible(False)
    axes.set_ylabel("lost", rotation="horizontal", ha="right", va="center")
    axes.set_xlabel("time [s]")


def _leaders(name: str, follows: Sequence[Placement]) -> list[str]:
    of_name = (placement.follows.leader for placement in follows if placement.vehicle == name)
    return list(dict.fromkeys(leader for leader in of_name if leader is not None))


def _lost_s(radio: pa.Table, receiver: str, sender: str) -> Array:
    """Sending times of lost frames of this link, s; with routing, of messages that arrived over no relay."""
    if "origin" in radio.column_names:
        return unreached_s(radio, receiver, sender)
    (receivers, to), (senders, by), (words, outcome) = (names_of(radio, name) for name in ("receiver", "sender", "outcome"))
    if receiver not in receivers or sender not in senders:
        return np.empty(0)
    not_lost = [number for number, word in enumerate(words) if word in NOT_LOST]
    lost = (to == receivers.index(receiver)) & (by == senders.index(sender)) & ~np.isin(outcome, not_lost)
    return np.asarray(numbers(radio, "sent_ns")[lost] / SECOND_NS)


def _legend(axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    vehicles = [place for place, label in enumerate(labels) if label not in EXPLAINED]
    others = [place for place, label in enumerate(labels) if label in EXPLAINED]
    places = [*vehicles[:LISTED], *others]
    axes.legend(list(map(handles.__getitem__, places)), list(map(labels.__getitem__, places)), ncols=5, **ABOVE)
    if len(vehicles) > LISTED:
        axes.set_title(f"and {len(vehicles) - LISTED} more", loc="right", fontsize="small")
