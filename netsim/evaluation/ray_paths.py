"""The paths of rays between given points, as a table."""

import math
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.rays.loss import Rays, Traced

_COLUMNS: dict[str, Any] = {
    "a": pa.int64(),
    "b": pa.int64(),
    "kinds": pa.string(),
    "gain_db": pa.float64(),
    "phase_rad": pa.float64(),
    "delay_ns": pa.float64(),
    "points": pa.list_(pa.list_(pa.float64())),
}

SCHEMA = pa.schema(_COLUMNS)
"""Rows counted from 0; interactions in order; of the factor from sent to received wave, exp(+j w t); m."""

_BLOCK = 1024  # pairs at a time


def ray_paths(channel: Channel, points: Floats) -> pa.Table:
    """All paths between points (n, 3) m: a row a path, by pair a < b and delay.

    Raises:
        ScenarioError: the path loss is not by rays.
        UsageError: a point inside a solid, or below the ground.
    """
    rays = channel.budgets.path_loss
    if not isinstance(rays, Rays):
        raise ScenarioError("paths need path_loss.kind = 'rays'", key="radio.path_loss.kind")
    for number, holder in enumerate(rays.holder(points)):
        if holder:
            raise UsageError(f"point {number} (row {number + 1} of the points) is inside {holder}: move it outside")
        if rays.ground != "none" and points[number, 2] < 0.0:
            raise UsageError(f"point {number} (row {number + 1} of the points) is below the ground: move it up, or set ground")
    a, b = np.triu_indices(len(points), 1)
    rows: list[dict[str, Any]] = []
    for first in range(0, len(a), _BLOCK):
        some = slice(first, first + _BLOCK)
        rows += _rows(rays.traced(points[a[some]], points[b[some]]), first)
    rows.sort(key=lambda row: (row["pair"], row["delay_ns"]))
    for row in rows:
        pair = row.pop("pair")
        row["a"], row["b"] = int(a[pair]), int(b[pair])
    return pa.Table.from_pylist(rows, SCHEMA)


def _rows(traced: Traced, first: int) -> list[dict[str, Any]]:
    rows, table, roofs = [], traced.table, traced.roofs
    for path, pair in enumerate(table.pair.tolist()):
        rows.append(_row(first + pair, table.gain[path], table.length_m[path], *_steps(traced, path)))
    for number, pair in enumerate(traced.dark.tolist()):
        edges = roofs.edge[roofs.edge_of == number].tolist()
        rows.append(_row(first + pair, roofs.gain[number], roofs.length_m[number], ["diffraction"] * len(edges), edges))
    return rows


def _steps(traced: Traced, path: int) -> tuple[list[str], list[list[float]]]:
    """Kinds and points of the interactions of a path, in order."""
    table = traced.table
    pair, count = table.pair[path], int(table.steps[path])
    corners = [traced.a[pair], *table.point[path, :count], traced.b[pair]]
    steps = []
    for leg in range(count):
        kind = "reflection" if table.element[path, leg] >= 0 else "diffraction"
        steps.append((float(leg + 1), kind, corners[leg + 1]))
    begin, end = np.searchsorted(table.pass_path, (path, path + 1))
    for leg, share in zip(table.pass_leg[begin:end].tolist(), table.pass_at[begin:end].tolist(), strict=True):
        steps.append((leg + share, "transmission", corners[leg] + share * (corners[leg + 1] - corners[leg])))
    steps.sort(key=lambda step: step[0])
    kinds = [kind for _, kind, _ in steps]
    return kinds, [point.tolist() for *_, point in steps]


def _row(pair: int, gain: complex, length_m: float, kinds: list[str], points: list[list[float]]) -> dict[str, Any]:
    return {
        "pair": pair,
        "kinds": "+".join(kinds) or "direct",
        "gain_db": 20.0 * math.log10(abs(gain)),
        "phase_rad": math.atan2(gain.imag, gain.real),
        "delay_ns": float(length_m) / SPEED_OF_LIGHT * 1e9,
        "points": points,
    }
