"""Tables of a run's page: metrics, vehicles, links, losses and their causes, theory beside measurement."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis.link_budget import frame_report
from vcmvsp.cosim.analysis.links import Links, Log
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.metrics.catalogue import GROUPS, MANY, metric_of, unit_of
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.report.laws import Expected, MeasuredRun, laws
from vcmvsp.cosim.report.page import Part, Rows, Words, cell
from vcmvsp.cosim.report.run_folder import RunContent

LISTED_VEHICLES = 200
LISTED_LINKS = 150


def number_tables(metrics: Mapping[str, Any]) -> Iterator[tuple[str, Sequence[Part]]]:
    """Title and content of each group of metrics, except the faults of agents (`fault_table`)."""
    for group, (title, introduction) in GROUPS.items():
        if group not in metrics:
            continue
        values = metrics[group]
        parts: list[Part] = [Words(introduction)] if introduction else []
        if group == "hardware":
            parts += [_by_vehicle(group, values), *_explained(group, values)]
        else:
            parts += _table(group, values)
            parts += [_by_vehicle(group, values[name]) for name in MANY if values.get(name)]
        yield title, parts


def fault_table(agents: Mapping[str, Any]) -> Sequence[Part]:
    """Agents with missed ticks or other faults; a sentence if there are none."""
    faulty = {vehicle: faults for vehicle, faults in agents.items() if any(faults.values())}
    if not faulty:
        return [Words("No agent missed a tick, and none was late.")]
    return [_by_vehicle("agents", faulty), *_explained("agents", faulty)]


def _table(group: str, values: Mapping[str, Any]) -> Iterator[Part]:
    pairs = [(path, value) for path, value in flat(values) if value is not None]
    if pairs:
        entries = [(path, value, (group, *path)) for path, value in pairs]
        rows = [[".".join(path), value, unit_of(name), metric_of(name).meaning] for path, value, name in entries]
        yield Rows(["number", "value", "unit", "what it is"], rows)
    if untold := [".".join(path) for path, value in flat(values) if value is None]:
        yield Words(f"There was nothing to measure for {', '.join(untold)}.")


def flat(table: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of each metric, except per-vehicle tables."""
    for name, value in table.items():
        if name in MANY:
            continue
        if isinstance(value, Mapping):
            yield from flat(value, (*above, name))
        else:
            yield (*above, name), value


def _by_vehicle(group: str, of: Mapping[str, Mapping[str, Any]]) -> Rows:
    rows = {vehicle: dict(flat(each)) for vehicle, each in of.items()}
    paths = dict.fromkeys(path for each in rows.values() for path in each)
    measured = {path for each in rows.values() for path, value in each.items() if value is not None}
    columns = [path for path in paths if path in measured]
    head = [_heading(group, path) for path in columns]
    return Rows(["vehicle", *head], [[vehicle, *map(each.get, columns)] for vehicle, each in rows.items()])


def _heading(group: str, path: tuple[str, ...]) -> str:
    unit = unit_of((group, *path))
    return ".".join(path) + (f" [{unit}]" if unit else "")


def _explained(group: str, of: Mapping[str, Mapping[str, Any]]) -> Sequence[Part]:
    names = dict.fromkeys(name for each in of.values() for name in each)
    return [Words("; ".join(f"{name}: {metric_of((group, '*', name)).meaning}" for name in names) + ".")]


def vehicle_table(content: RunContent) -> Sequence[Part]:
    """One row per vehicle."""
    table_of = {each["name"]: each for each in content.scenario.get("vehicle", []) if "name" in each}
    names = list(table_of) if content.recording is None else list(content.recording.facts.vehicles)
    names = names or content.head.get("vehicles", "").split()
    if not names:
        return []
    leaders: dict[str, str] = {}
    for each in () if content.recording is None else content.recording.follows:
        leaders[each.vehicle] = each.follows.leader or ""
    ways, air = _ways(content), _air(content)
    kind = content.scenario.get("vehicles", {}).get("kind", "")
    rows: list[list[Any]] = []
    for name in names[:LISTED_VEHICLES]:
        own = table_of.get(name, {})
        label = own.get("kind", kind) + (f", real ({own['driver'].get('kind', '')})" if "driver" in own else "")
        agent = own["agent"].get("kind", content.scenario.get("agents", {}).get("kind", "")) if "agent" in own else ""
        rows.append([name, label, agent, leaders.get(name, ""), *ways.get(name, [None] * 3), *air.get(name, [None] * 3)])
    head = ["vehicle", "kind", "agent", "follows", "way [m]", "mean speed [m/s]", "ends at [m]"]
    parts: list[Part] = [Rows([*head, "frames sent", "delivered of these [%]", "heard of others [%]"], rows)]
    if len(names) > LISTED_VEHICLES:
        parts.append(Words(f"And {len(names) - LISTED_VEHICLES} more."))
    return parts


def _ways(content: RunContent) -> dict[str, list[Any]]:
    if content.recording is None:
        return {}
    moved = motion(content.recording.states)
    cells_of: dict[str, list[Any]] = {}
    for i, name in enumerate(moved.names):
        is_known = np.isfinite(moved.position[:, :, i]).all(axis=0)
        place, times = moved.position[:, is_known, i], moved.time_ns[is_known] / SECOND_NS
        if not place.size:
            continue
        way = float(np.sqrt((np.diff(place, axis=1) ** 2).sum(axis=0)).sum())
        lasted = float(times[-1] - times[0])
        end = ",\u00a0".join(f"{value + 0.0:.2f}" for value in np.round(place[:, -1], 2).tolist())
        cells_of[name] = [way, way / lasted if lasted else None, end]
    return cells_of


def _air(content: RunContent) -> dict[str, list[Any]]:
    if content.links is None or content.recording is None:
        return {}
    links = content.links
    cells_of: dict[str, list[Any]] = {}
    decided = links.sent - links.under_way
    for i, name in enumerate(links.names):
        cells_of[name] = [int(links.frames[i])]
        for received, of in ((links.received[i], decided[i]), (links.received[:, i], decided[:, i])):
            cells_of[name].append(_percent(float(received.sum() / of.sum())) if of.any() else None)
    return cells_of


def link_table(links: Links) -> Sequence[Part]:
    """All links, lowest delivery ratio first."""
    pairs = sorted(links.pairs, key=lambda pair: 2.0 if (ratio := links.ratio(*pair)) is None else ratio)
    if not pairs:
        return [Words("Nothing was sent.")]
    under_way = bool(links.under_way.any())
    rows: list[list[Any]] = []
    for a, b in pairs[:LISTED_LINKS]:
        level = float(links.level_dbm[a, b])
        counts = [int(links.sent[a, b]), int(links.received[a, b])]
        counts += [int(links.under_way[a, b])] if under_way else []
        level_cell = None if np.isnan(level) else round(level, 1)
        rows.append([links.names[a], links.names[b], *counts, _percent(links.ratio(a, b)), level_cell, links.lost_to(a, b)])
    head = ["from", "to", "sent", "received", *(["under way"] if under_way else [])]
    head += ["delivered [%]", "mean level [dBm]", "lost to"]
    parts: list[Part] = [Rows(head, rows)]
    if len(pairs) > LISTED_LINKS:
        parts.append(Words(f"And {len(pairs) - LISTED_LINKS} links that delivered more: vcmvsp radio shows each."))
    return parts


def loss_table(links: Links, folder: Path) -> Sequence[Part]:
    """Causes of losses, the most frequent first, each with its worst link and an example in words."""
    total = int(links.sent.sum())
    if not total:
        return []
    if not links.losses:
        return [Words("Nothing was lost.")]
    log = Log(folder)
    worst = [np.unravel_index(int(lost.argmax()), lost.shape) for lost in links.losses.values()]
    log.only([(links.names[a], links.names[b]) for a, b in worst])
    rows: list[list[Any]] = []
    for (cause, lost), (a, b) in zip(links.losses.items(), worst, strict=True):
        pair = links.names[a], links.names[b]
        count = int(lost.sum())
        most = f"{pair[0]} to {pair[1]}: {int(lost[a, b])}"
        rows.append([cause, count, _percent(count / total), most, _example(log, pair, cause)])
    return [
        Words(f"Of {total} frames, counted at each receiver, {sum(row[1] for row in rows)} were lost."),
        Rows(["cause", "frames", "share [%]", "most on", "for example"], rows),
    ]


def _example(log: Log, pair: tuple[str, str], cause: str) -> str:
    frames = log.frames(pair)
    lost = frames.decided.select(np.array([word == cause for word in frames.decided.words("outcome")], np.bool_))
    try:
        report = frame_report(log, pair, str(lost["frame"].tolist()[0]), with_scenario=False)
    except VcmvspError:
        return ""
    why = report["why"].removeprefix("lost: ").removeprefix(f"{cause}: ")
    return f"frame {report['frame']} at {report['sent_s']:.3f} s: {why}"


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100.0 * share, 1)


def expectation_table(content: RunContent) -> list[Part]:
    """Expected and measured values; empty if no law applies.

    The half-widths hold for 95 % of all runs that differ in random draws alone; without randomness there is none.
    """
    rows = [
        [each.quantity, each.unit, each.expected, _range(each), each.measured, each.law, each.holds]
        for each in _expected(content)
    ]
    if not rows:
        return []
    head = ["quantity", "unit", "expected", "95 % of runs", "measured", "law", "it holds because"]
    return [
        Words("Closed forms, where this scenario is as they assume. Chance alone puts one number in twenty outside its range."),
        Rows(head, rows),
    ]


def _expected(content: RunContent) -> Iterator[Expected]:
    recording, radio, links = content.recording, content.radio, content.links
    if recording is None or radio is None or links is None or not content.scenario or not content.metrics:
        return
    if content.scenario.get("intervention"):  # the operator intervened
        return
    with contextlib.suppress(KeyError):  # a scenario of another version may lack a key of a law
        yield from laws(MeasuredRun(content.scenario, content.metrics, recording, radio, links, motion(recording.states)))


def _range(each: Expected) -> str | None:
    return None if each.spread is None else f"{cell(each.expected - each.spread)} to {cell(each.expected + each.spread)}"
