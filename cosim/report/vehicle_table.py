"""The vehicles of a run: what each is, where it went, and what it sent and heard."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.report.page import Part, Rows, Words
from vcmvsp.cosim.report.run_folder import Left

LISTED = 200


def vehicle_table(left: Left) -> Sequence[Part]:
    """A row for each vehicle."""
    said = {each["name"]: each for each in left.scenario.get("vehicle", []) if "name" in each}
    names = list(said) if left.recording is None else list(left.recording.facts.vehicles)
    names = names or left.head.get("vehicles", "").split()
    if not names:
        return []
    leaders: dict[str, str] = {}
    for each in () if left.recording is None else left.recording.follows:
        leaders[each.vehicle] = each.follows.leader or ""
    ways, air = _ways(left), _air(left)
    kind = left.scenario.get("vehicles", {}).get("kind", "")
    rows: list[list[Any]] = []
    for name in names[:LISTED]:
        own = said.get(name, {})
        what = own.get("kind", kind) + (f", real ({own['driver'].get('kind', '')})" if "driver" in own else "")
        agent = own["agent"].get("kind", left.scenario.get("agents", {}).get("kind", "")) if "agent" in own else ""
        rows.append([name, what, agent, leaders.get(name, ""), *ways.get(name, [None] * 3), *air.get(name, [None] * 3)])
    head = ["vehicle", "kind", "agent", "follows", "way [m]", "mean speed [m/s]", "ends at [m]"]
    parts: list[Part] = [Rows([*head, "frames sent", "delivered of these [%]", "heard of others [%]"], rows)]
    if len(names) > LISTED:
        parts.append(Words(f"And {len(names) - LISTED} more."))
    return parts


def _ways(left: Left) -> dict[str, list[Any]]:
    """Of each vehicle its way, mean speed and last place."""
    if left.recording is None:
        return {}
    moved = motion(left.recording.states)
    found: dict[str, list[Any]] = {}
    for i, name in enumerate(moved.names):
        there = np.isfinite(moved.position[:, :, i]).all(axis=0)
        place, times = moved.position[:, there, i], moved.time_ns[there] / SECOND_NS
        if not place.size:
            continue
        way = float(np.sqrt((np.diff(place, axis=1) ** 2).sum(axis=0)).sum())
        lasted = float(times[-1] - times[0])
        end = ",\u00a0".join(f"{value + 0.0:.2f}" for value in np.round(place[:, -1], 2).tolist())
        found[name] = [way, way / lasted if lasted else None, end]
    return found


def _air(left: Left) -> dict[str, list[Any]]:
    """Of each vehicle the frames that it sent, and which share of them, and of those of others, arrived."""
    if left.links is None or left.recording is None:
        return {}
    links, found = left.links, {}
    decided = links.sent - links.under_way
    for i, name in enumerate(links.names):
        shares = [(links.received[part].sum(), decided[part].sum()) for part in (np.s_[i, :], np.s_[:, i])]
        found[name] = [int(links.frames[i]), *(round(100.0 * float(got / of), 1) if of else None for got, of in shares)]
    return found
