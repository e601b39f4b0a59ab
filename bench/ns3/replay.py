"""Frame by frame: our contention core gets ns-3's frames **and its backoffs**, and must do the same.

``python -m bench.ns3.replay``: of every frame, when its last attempt began, how many there were, and who received it. Light is
a hundred times faster here, so that the clocks of both do not drift apart (the core knows no time of flight), and yet nothing
happens at the same instant. Chance remains in what noise and interference spoil: where a payload is as likely lost as
not, the two part, and with EIFS all that follows.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from bench.ns3 import program
from bench.ns3.cases import Case
from bench.ns3.core import Air
from bench.ns3.program import Floats, Frames, Ints
from cosim.clock import SECOND_NS
from netsim.medium import Decided, Fate, Offered

LIGHT = "--ns3::ConstantSpeedPropagationDelayModel::Speed=3e10"
NEAR_NS = 8_000  # less than a slot
UNDECIDED_NS = 3_000_000  # at the end: what ns-3 has not finished

CASES = (
    (Case("b-1", 10, 10), 2.0),
    (Case("b-1", 50, 10), 1.0),
    (Case("b-1", 100, 10), 0.5),
    (Case("b-1", 10, 100), 1.0),
    (Case("g-6", 50, 100), 0.1),
    (Case("b-1", 50, 20, side_m=600.0, exponent=3.0), 1.0),
    (Case("g-6", 50, 20, side_m=600.0, exponent=3.0), 1.0),
    (Case("b-11", 10, 20, unicast=True), 1.0),
    (Case("b-1", 5, 0, saturated=True), 0.5),
    (Case("b-1", 5, 0, saturated=True, unicast=True), 0.3),
    (Case("g-6", 5, 0, saturated=True, unicast=True), 0.1),
    (Case("a-6", 5, 0, saturated=True, unicast=True), 0.1),
)


def replay(case: Case, duration_s: float, seed: int = 1) -> tuple[int, int]:
    """How many frames agree, and of how many."""
    frames, last_ns, draws = _judge(case, duration_s, seed)
    decided = _ours(case, frames, draws, round(duration_s * SECOND_NS) - UNDECIDED_NS)
    numbers = [number for number in decided if frames.attempts[number] > 0]
    return sum(_same(decided[number], frames, number, int(last_ns[number])) for number in numbers), len(numbers)


def _same(ours: Decided, frames: Frames, number: int, last_ns: int) -> bool:
    received = frames.delay_ns[number] >= 0
    meant = (
        np.arange(len(received)) == frames.to[number]
        if frames.to[number] >= 0
        else np.arange(len(received)) != frames.sender[number]
    )
    if ours.attempts != frames.attempts[number] or abs(ours.start_ns - last_ns) > NEAR_NS:
        return False
    return bool(((ours.fate == Fate.RECEIVED) & meant == received).all())


def _judge(case: Case, duration_s: float, seed: int) -> tuple[Frames, Ints, list[list[float]]]:
    """The frames, when each began for the last time, and of each radio what it drew, as numbers from 0 to 1."""
    stem = program.folder() / f"replay-{case.name}"
    places, out = stem.with_suffix(".csv"), stem.with_suffix(".bin")
    places.write_text("".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in case.positions.tolist()))
    options = case.ns3(seed) | {"duration": duration_s, "warmup": 0, "drain": 0, "log": 1}
    words = [f"--{name}={value}" for name, value in options.items()]
    command = [str(program.program()), f"--positions={places}", f"--out={out}", LIGHT, *words]
    log = subprocess.run(command, check=True, text=True, capture_output=True).stderr
    draws: list[list[float]] = [[] for _ in range(case.nodes)]
    window = [0] * case.nodes
    for line in log.splitlines():
        _, node, what, *more = line.split()
        if what == "cw":
            window[int(node)] = int(more[0])
        elif what == "backoff":
            draws[int(node)].append((int(more[0]) + 0.5) / (window[int(node)] + 1))
        elif [what, *more] == ["tx", "control"]:  # the core draws for an acknowledgement too: whether it survives
            draws[int(node)].append(0.5)
    rows = np.fromfile(out, np.int64).reshape(-1, 7 + case.nodes)
    return program.read(Path(out), case.nodes), rows[:, 5], draws


def _ours(case: Case, frames: Frames, draws: Sequence[Sequence[float]], until_ns: int) -> dict[int, Decided]:
    """What the core makes of the same frames, by number."""
    air, n = Air(case, seed=1), case.nodes
    store = np.full((n, max(map(len, draws)) + 1_000), 0.5)
    for radio, values in enumerate(draws):
        store[radio, : len(values)] = values

    def uniform(keys: Any, numbers: Any, _slot: int) -> Floats:
        radio, number = np.broadcast_arrays(keys, numbers)
        drawn = store[radio.astype(int), np.minimum(number.astype(int), store.shape[1] - 1)]
        return np.stack([drawn, np.full_like(drawn, 0.5)], axis=-1)

    with mock.patch("netsim.dcf_medium.link_uniform", uniform):
        medium = air.open(np.arange(n, dtype=np.uint64))
        for sender, to, sent_ns in zip(frames.sender.tolist(), frames.to.tolist(), frames.sent_ns.tolist(), strict=True):
            offered: Offered = air.frame(sender, to, sent_ns)
            medium.offer(offered)
        return {each.number: each for each in medium.advance(until_ns)}


def main() -> int:
    """Print a line for each network; 1 if one agrees in less than 98 % of its frames."""
    worst = 1.0
    for case, duration_s in CASES:
        same, frames = replay(case, duration_s)
        worst = min(worst, same / frames)
        print(f"{case.name:40} {same:6} of {frames:6} frames agree", flush=True)
    return 0 if worst >= 0.98 else 1


if __name__ == "__main__":
    sys.exit(main())
