"""Figures of a reconnaissance mission: commanders and finds over time, the map over time, the mosaic, the detections."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.patheffects import withStroke

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.mission import Target, target_at
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.plots.run_plots import draw_vehicle
from vcmvsp.cosim.plots.style import ABOVE, GREY, MAP, style
from vcmvsp.cosim.recording.foxglove import corners_of, label_of
from vcmvsp.cosim.recording.mission_log import MissionLog, surest_map
from vcmvsp.cosim.types import Array, Sighting, Sightings
from vcmvsp.cosim.util.palette import COMMANDERS, PROBABILITY, TARGET, color_of
from vcmvsp.cosim.util.pictures import decoded

INSTANTS = 4  # map snapshots
APART = 0.02  # of the run: nearer events share a snapshot
SHEET = 12  # maximum number of pictures with detections
HATCHES = {"search": "", "formation": "\\\\\\\\", "track": "..", "avoid1": "////", "avoid2": "xxxx"}
HATCH = "#ffffff80"
EDGE = "0.15"  # of a target's marker
COLORS = LinearSegmentedColormap.from_list("probability", PROBABILITY)
MARKED: dict[str, Any] = {
    "marker": "*",
    "markersize": 12.0,
    "markerfacecolor": TARGET,
    "markeredgecolor": EDGE,
    "linestyle": "",
}
OPEN: dict[str, Any] = {  # around dots, which it does not hide
    **MARKED,
    "markersize": 18.0,
    "markerfacecolor": "none",
    "markeredgecolor": TARGET,
    "markeredgewidth": 1.4,
}
FALSE: dict[str, Any] = {"marker": "X", "markersize": 8.0, "color": "white", "markeredgecolor": EDGE, "linestyle": ""}
GIVEN_UP: dict[str, Any] = {**FALSE, "marker": "v", "markersize": 7.0}
DOT: dict[str, Any] = {"marker": "o", "markersize": 4.0, "markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": ""}


def mission(log: MissionLog, moved: Motion, targets: Sequence[Target], outlines: Sequence[Array]) -> Figure:
    """Commanders of all vehicles over time; below, the merged map (`surest_map`) at `INSTANTS` instants with tracks.

    Stars are finds, crosses false finds, triangles abandoned targets; on the maps, stars are true positions.
    """
    with style(MAP):
        shapes = [grid.seen.shape for maps in log.maps.values() for _, grid in maps[:1]]
        rows, columns = shapes[0] if shapes else (1, 1)
        slenderness = np.clip(rows / max(columns, 1), 0.4, 2.5)  # aspect ratio of the maps: height over width
        heights = 1.1 + 0.3 * len(log.vehicles), 0.9 + 2.35 * slenderness  # inches
        figure = Figure(figsize=(11.0, sum(heights)), layout="constrained")
        figure.suptitle("Commander of each vehicle, and the map of the search")
        above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=heights).flat
        _timeline(above.add_subplot(), log, targets)
        _maps(below, log, moved, targets, outlines)
    return figure


def mosaic(log: MissionLog, moved: Motion, targets: Sequence[Target]) -> Figure:
    """The merged mosaic of all vehicles, with tracks, detections and the targets' true positions at the end."""
    with style(MAP):
        figure = Figure(figsize=(7.0, 7.2), layout="constrained")
        figure.suptitle("Mosaic of the ground, from the pictures of all vehicles")
        axes = figure.add_subplot()
        axes.set_facecolor("0.25")
        for each in log.mosaics.values():
            alpha = np.uint8(255) * each.pixels.any(axis=2)
            axes.imshow(np.dstack((each.pixels, alpha)), **_extent(each.left, each.bottom, each.cell_m, each.pixels))
        for index, name in enumerate(log.vehicles):
            _track(axes, moved, name, index, log.end_ns, halo=True)
            sightings = [sighting for _, each in log.sightings.get(name, ()) for sighting in each.found]
            places = np.array([each.place for each in sightings]).reshape(-1, 2)
            axes.plot(*places.T, color=color_of(index), zorder=6, **DOT)  # above the vehicle
        _true_places(axes, targets, log.end_ns, OPEN, named=True)
        _square(axes)
        dots = Line2D([], [], color=GREY, label="recognised here", **DOT)
        lines = [Line2D([], [], color=color_of(index), label=name) for index, name in enumerate(log.vehicles)]
        lines += [dots, Line2D([], [], label="target, at the end", **OPEN)]
        figure.legend(handles=lines, loc="outside lower left", ncols=6, frameon=False)
    return figure


def detections(log: MissionLog) -> Figure:
    """A contact sheet of up to `SHEET` pictures in which targets were recognised (`chosen_pictures`)."""
    import cv2

    with style(MAP):
        chosen = chosen_pictures(log)
        columns = min(len(chosen), 4) or 1
        rows = -(-len(chosen) // columns) or 1
        figure = Figure(figsize=(3.0 * columns, 2.55 * rows + 0.3), layout="constrained")
        figure.suptitle("Recognised targets")
        for axes, (time_ns, name, sightings) in zip(figure.subplots(rows, columns, squeeze=False).flat, chosen, strict=False):
            pixels = decoded(sightings.jpeg, cv2.IMREAD_COLOR)
            if pixels is not None:
                axes.imshow(pixels[..., ::-1], extent=(-0.5, sightings.width - 0.5, sightings.height - 0.5, -0.5))
            _boxes(axes, sightings)
            axes.set_title(f"{name}, {time_ns / SECOND_NS:.1f} s", color=color_of(log.vehicles.index(name)))
        for axes in figure.axes:
            axes.set_axis_off()
    return figure


def chosen_pictures(log: MissionLog) -> list[tuple[int, str, Sightings]]:
    """Time (ns), vehicle and sightings of the pictures on the contact sheet, in order of time.

    For each vehicle and target: the first picture, then those in which the target's position differs most.
    """
    pairs: dict[tuple[str, str], list[tuple[int, str, Sightings]]] = {}
    for name, series in log.sightings.items():
        for time_ns, sightings in series:
            if sightings.jpeg and sightings.found:
                pairs.setdefault((name, _best(sightings).target), []).append((time_ns, name, sightings))
    groups = sorted(pairs.values(), key=lambda group: group[0][:2])[:SHEET]
    chosen = [each for group in groups for each in _apart(group, SHEET // len(groups))]
    return sorted(chosen, key=lambda each: each[:2])


def _best(sightings: Sightings) -> Sighting:
    return max(sightings.found, key=lambda each: each.score)


def _apart(group: Sequence[tuple[int, str, Sightings]], count: int) -> list[tuple[int, str, Sightings]]:
    """The first sighting, then repeatedly the one farthest from all chosen so far, by the target's position in the picture."""
    places = np.array([_best(sightings).centre_px for _, _, sightings in group])
    away = np.full(len(group), np.inf)
    chosen, newest = [0], 0
    while len(chosen) < min(count, len(group)):
        away = np.minimum(away, np.hypot(*(places - places[newest]).T))
        away[chosen] = -1.0
        newest = int(away.argmax())
        chosen.append(newest)
    return [group[number] for number in chosen]


def _timeline(axes: Axes, log: MissionLog, targets: Sequence[Target]) -> None:
    end_s = log.end_ns / SECOND_NS
    commanders: set[str] = set()
    for row, name in enumerate(log.vehicles):
        changes = [*log.noted.of(name, "commander"), (log.end_ns, "")]
        for (begin, commander), (end, _) in pairwise(changes):
            if not commander:  # its agent has failed or is lost
                continue
            commanders.add(commander)
            span = begin / SECOND_NS, (end - begin) / SECOND_NS
            axes.broken_barh([span], (row - 0.3, 0.6), **_band(commander))
        for time_ns, target in log.noted.lost(name):
            axes.plot(time_ns / SECOND_NS, row, zorder=5, **GIVEN_UP)
            _say(axes, time_ns / SECOND_NS, row + 0.42, target, "top")
    _finds(axes, log, targets)
    axes.set_yticks(range(len(log.vehicles)), log.vehicles)
    for index, label in enumerate(axes.get_yticklabels()):  # in the colours of the tracks below
        label.set_color(color_of(index))
    axes.set_ylim(len(log.vehicles) - 0.2, -0.8)
    axes.set_xlim(0.0, max(end_s, 1e-3))
    axes.set_xlabel("time [s]")
    for side in ("left", "top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(axis="y", length=0.0)
    handles: list[Artist] = [Patch(**_band(name), label=name) for name in COMMANDERS if name in commanders]
    handles += [Patch(**_band("other"), label="other")] if commanders - COMMANDERS.keys() else []
    for mark, words in ((MARKED, "found"), (FALSE, "no target there"), (GIVEN_UP, "given up")):
        handles.append(Line2D([], [], label=words, **mark))
    axes.legend(handles=handles, ncols=len(handles), **ABOVE)


def _band(commander: str) -> dict[str, Any]:
    return {
        "facecolor": COMMANDERS.get(commander, GREY),
        "hatch": HATCHES.get(commander, "--"),
        "edgecolor": HATCH,
        "linewidth": 0.0,
    }


def _finds(axes: Axes, log: MissionLog, targets: Sequence[Target]) -> None:
    labelled: set[tuple[str, str]] = set()
    for find in log.noted.found:
        if find.vehicle not in log.vehicles:
            continue
        row, target = log.vehicles.index(find.vehicle), target_at(targets, find)
        axes.plot(find.time_ns / SECOND_NS, row, zorder=6, **(MARKED if target else FALSE))
        name = target.name if target else find.name
        if (find.vehicle, name) not in labelled:
            labelled.add((find.vehicle, name))
            _say(axes, find.time_ns / SECOND_NS, row - 0.36, name, "bottom")


def _say(axes: Axes, time_s: float, height: float, words: str, where: str) -> None:
    axes.annotate(words, (time_s, height), ha="center", va=where, fontsize="small", zorder=7)


def instants_of(log: MissionLog, targets: Sequence[Target]) -> list[tuple[int, str]]:
    """Times, ns, of `INSTANTS` map snapshots and what happened then: first finds, then targets given up, and the end.

    Where less has happened, the largest gaps are halved.
    """
    finds: dict[str, int] = {}
    for find in log.noted.found:
        if (target := target_at(targets, find)) is not None:
            finds.setdefault(target.name, find.time_ns)
    events = [(time_ns, f"{name} found") for name, time_ns in sorted(finds.items(), key=lambda each: each[1])]
    events += [(time_ns, f"{target} given up") for name in log.vehicles for time_ns, target in log.noted.lost(name)]
    chosen = {log.end_ns: "the end"}
    for time_ns, event in events:
        if len(chosen) < INSTANTS and all(abs(time_ns - chosen_ns) > APART * log.end_ns for chosen_ns in chosen):
            chosen[time_ns] = event
    while len(chosen) < min(INSTANTS, log.end_ns):
        begin, end = max(pairwise(sorted({0, *chosen})), key=lambda gap: gap[1] - gap[0])
        chosen[(begin + end) // 2] = ""
    return sorted(chosen.items())


def _maps(figure: FigureBase, log: MissionLog, moved: Motion, targets: Sequence[Target], outlines: Sequence[Array]) -> None:
    chosen = instants_of(log, targets)
    panels, image = figure.subplots(1, len(chosen), sharex=True, sharey=True, squeeze=False)[0], None
    for number, (axes, (now, event)) in enumerate(zip(panels, chosen, strict=True), start=1):
        grids, surest = surest_map(log, now)
        if grids is not None:
            extent = _extent(grids.left, grids.bottom, grids.cell_m, surest)
            image = axes.imshow(surest / 255.0, cmap=COLORS, vmin=0.0, vmax=1.0, **extent)
        solids = PolyCollection(outlines, facecolor="none", edgecolor="0.35", linewidth=0.7, zorder=2)
        axes.add_collection(solids, autolim=False)
        for index, name in enumerate(log.vehicles):
            _track(axes, moved, name, index, now)
        _true_places(axes, targets, now, MARKED, named=number == 1)
        _square(axes)
        axes.set_title(": ".join(filter(None, (f"{now / SECOND_NS:g} s", event))))
        axes.label_outer()
    if image is not None:
        figure.colorbar(image, ax=panels, shrink=0.7, pad=0.01, label="P(target) [1]")


def _track(axes: Axes, moved: Motion, name: str, index: int, now_ns: int, *, halo: bool = False) -> None:
    if name not in moved.names:
        return
    until, column = int(np.searchsorted(moved.time_ns, now_ns, side="right")), moved.column(name)
    x, y, _ = moved.position[:, :until, column]
    effects = [withStroke(linewidth=2.6, foreground="white", alpha=0.7)] if halo else []
    axes.plot(x, y, color=color_of(index), linewidth=1.0, zorder=3, path_effects=effects)
    if until:
        draw_vehicle(axes, (x[-1], y[-1], moved.yaw[until - 1, column]), color_of(index), 10.0)


def _true_places(axes: Axes, targets: Sequence[Target], now_ns: int, mark: dict[str, Any], *, named: bool) -> None:
    for target in targets:
        x, y = target.place(now_ns / SECOND_NS)
        axes.plot(x, y, zorder=4, **mark)
        if named:
            halo = [withStroke(linewidth=2.0, foreground="white")]
            beside, side = (10.0, "left") if x < np.mean(axes.get_xlim()) else (-10.0, "right")
            axes.annotate(target.name, (x, y), (beside, -3.0), textcoords="offset points", ha=side, zorder=7, path_effects=halo)


def _boxes(axes: Axes, sightings: Sightings) -> None:
    for each in sightings.found:
        corners = np.array(corners_of(each))
        axes.add_patch(Polygon(corners, fill=False, edgecolor=EDGE, linewidth=3.0))
        axes.add_patch(Polygon(corners, fill=False, edgecolor=TARGET, linewidth=1.4))
        axes.plot(*corners[:2].T, color=TARGET, linewidth=3.0)
        left, right = 0.14 * sightings.width, 0.86 * sightings.width  # between them the text stays inside
        middle = float(np.clip(each.centre_px[0], left, right))
        height, side = corners[:, 1].min() - 4.0, "bottom"
        if corners[:, 1].min() <= 0.12 * sightings.height:  # no room above it
            height, side = corners[:, 1].max() + 4.0, "top"
        axes.annotate(
            label_of(each),
            (middle, height),
            ha="center",
            va=side,
            color=TARGET,
            path_effects=[withStroke(linewidth=2.0, foreground=EDGE)],
            annotation_clip=True,
        )
    axes.set_xlim(-0.5, sightings.width - 0.5)
    axes.set_ylim(sightings.height - 0.5, -0.5)


def _extent(left: float, bottom: float, cell_m: float, cells: Array) -> dict[str, Any]:
    rows, columns = cells.shape[:2]
    edges = (left, left + cell_m * columns, bottom, bottom + cell_m * rows)
    return {"extent": edges, "origin": "lower", "interpolation": "nearest", "zorder": 1}


def _square(axes: Axes) -> None:
    axes.set_aspect("equal")
    axes.set_xlabel("x east [m]")
    axes.set_ylabel("y north [m]")
