"""Avoidance: one decision on a scan of 512 beams, beside textbook loops: VFH, and the dynamic window.

``python -m bench.avoidance`` prints the table. CPU time of this process, medians of pairs: compare the ratios.
"""

import math
import platform
from collections.abc import Callable, Sequence

import numpy as np

from bench.measure import Row, cpu, in_turn, table
from vcmvsp.agents.avoidance import DynamicWindow, Gap, PotentialField, Task, Vfh, View, view_of
from vcmvsp.agents.avoidance.method import Settings
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array, Scan

ROUNDS = 9
CALLS = 40  # in each
BEAMS, RANGE_M = 512, 20.0
ROBOT = Body(width_m=0.33, radius_m=0.216)
PERIOD_S = 0.1
LIMIT_S = 0.5e-3

# Obstacles of the room: x and y of the lower and the upper corner, m. The robot is at the origin, its goal behind the pillar.
ROOM = ((0.8, -0.3, 1.3, 0.3), (0.3, 0.7, 2.0, 0.9), (0.1, -1.2, 2.0, -1.0), (3.0, -3.0, 3.2, 3.0), (-3.0, 2.0, 3.0, 2.2))
AIM = (2.5, 0.1)
TASK = Task((0.3, 0.0), 0.0, AIM)


def rows() -> list[Row]:
    """All rows."""
    room = _view(_ranges())
    ranges, bearings, points = room.ranges.tolist(), room.bearings.tolist(), room.units * room.ranges[:, None]
    beams, window = lambda: loop_of_vfh(ranges, bearings), lambda: loop_of_window(points)
    return [
        *(_row(each, room, "a plain loop over beams (VFH)", beams) for each in (PotentialField(), Gap(), Vfh())),
        _row(DynamicWindow(), room, "a loop that simulates each of 55 candidates for 3 s", window),
    ]


def _row(settings: Settings, room: View, beside: str, loop: Callable[[], object]) -> Row:
    """One method; each round starts afresh, with a free path."""
    free = _view(np.full(BEAMS, math.inf))

    def ours() -> float:
        method = settings.method(ROBOT, PERIOD_S)
        method.decide(free, TASK)
        assert method.decide(room, TASK).mode != "task"  # it does work
        return cpu(lambda: [method.decide(room, TASK) for _ in range(CALLS)]) / CALLS

    def other() -> float:
        assert loop() is not None
        return cpu(lambda: [loop() for _ in range(CALLS)]) / CALLS

    our_s, other_s, ratio = in_turn(ours, other, ROUNDS)
    kind = type(settings).__struct_config__.tag
    name = f"avoidance `{kind}`, one decision on {BEAMS} beams in a room; beside {beside}"
    return Row(
        name, f"{1e6 * our_s:.0f} us", f"{1e6 * other_s:.0f} us", ratio, f"goal: <= {1e6 * LIMIT_S:.0f} us", our_s <= LIMIT_S
    )


def loop_of_vfh(ranges: Sequence[float], bearings: Sequence[float], keep: float = 0.266, near: float = 1.2) -> float | None:
    """Direction of VFH, rad, without hysteresis or turning circles: loops over beams, sectors and openings."""
    sectors, wide = 72, 16
    width = math.tau / sectors
    density = [0.0] * sectors
    for distance, bearing in zip(ranges, bearings, strict=True):
        if distance >= near:
            continue
        magnitude = 1.0 - (distance / near) ** 2
        half = math.asin(min(1.0, keep / max(distance, keep)))
        for k in range(math.ceil((bearing - half) / width), math.floor((bearing + half) / width) + 1):
            density[k % sectors] += magnitude
    target, best, cheapest = round(math.atan2(AIM[1], AIM[0]) / width), None, math.inf
    blocked = [each > 0.0 or abs((k + sectors // 2) % sectors - sectors // 2) > sectors // 4 for k, each in enumerate(density)]
    for first in range(sectors):
        if blocked[first] or not blocked[first - 1]:
            continue
        last = first
        while not blocked[(last + 1) % sectors] and last - first < sectors:
            last += 1
        entries = [first + wide // 2, last - wide // 2] if last - first > wide else [(first + last) // 2]
        if last - first > wide and (target - first) % sectors in range(wide // 2, last - first - wide // 2 + 1):
            entries.append(target)
        for k in entries:
            off, turn = (abs((k - other + sectors // 2) % sectors - sectors // 2) for other in (target, 0))
            if 5.0 * off + 4.0 * turn < cheapest:
                best, cheapest = k * width, 5.0 * off + 4.0 * turn
    return best


def loop_of_window(points: Array, keep: float = 0.266) -> tuple[float, float] | None:
    """The best speeds of the dynamic window, m/s and rad/s: each candidate is simulated in steps of 0.1 s."""
    best, most = None, -math.inf
    for v in np.linspace(0.25, 0.35, 5).tolist():
        for w in np.linspace(-0.105, 0.105, 11).tolist():
            x, y, yaw, way = 0.0, 0.0, 0.0, []
            for _ in range(30):
                x, y, yaw = x + 0.1 * v * math.cos(yaw), y + 0.1 * v * math.sin(yaw), yaw + 0.1 * w
                way.append((x, y))
            places = np.array(way)
            apart = np.hypot(points[:, None, 0] - places[:, 0], points[:, None, 1] - places[:, 1]).min(axis=0)
            free = 0.1 * v * (int((apart < keep).argmax()) if (apart < keep).any() else len(way))
            if v * v > 2.0 * 0.3 * free:
                continue
            heading = 1.0 - abs(math.atan2(AIM[1] - y, AIM[0] - x) - yaw) / math.pi
            if 0.8 * heading + 0.1 * free + 0.1 * v > most:
                best, most = (v, w), 0.8 * heading + 0.1 * free + 0.1 * v
    return best


def _view(ranges: Array) -> View:
    first, step = -0.5 * math.pi, math.pi / (BEAMS - 1)
    found = view_of(Scan(ranges=ranges.astype(np.float32), angle_min=first, angle_step=step, range_max=RANGE_M))
    assert found is not None
    return found


def _ranges() -> Array:
    """Scan of the room."""
    bearings = np.linspace(-0.5 * math.pi, 0.5 * math.pi, BEAMS)
    rays = np.stack([np.cos(bearings), np.sin(bearings)])[:, None]
    boxes = np.array(ROOM).reshape(-1, 2, 2).transpose(1, 2, 0)[..., None]  # (corner, axis, box, beam)
    enters, leaves = np.sort(boxes / rays, axis=0)
    meets, ends = enters.max(axis=0), leaves.min(axis=0)
    return np.where((meets <= ends) & (meets > 0.0), meets, math.inf).min(axis=0)


if __name__ == "__main__":
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    print(table(rows()))
