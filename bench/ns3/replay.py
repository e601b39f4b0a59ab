"""Frame by frame: our contention core gets ns-3's frames, **its backoffs and its random outcomes**, and must do the same.

``python -m bench.ns3.replay``: of every frame, the begin of its last attempt, the number of attempts, and its receivers. Light
is a hundred times faster here, so that the clocks of both do not drift apart (the core has no time of flight), and yet nothing
happens at the same instant. ns-3 also decides what a receiver decodes: a decoded frame has full patience there, any other
practically none. The core decides the times of transmissions and the frame to which each radio listens.
"""

import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from bench.ns3 import program
from bench.ns3.cases import SIZE, Case
from bench.ns3.core import Air
from bench.ns3.program import Floats, Frames, Ints
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Offered
from vcmvsp.netsim.mac.dcf.parameters import Dcf

LIGHT = "--ns3::ConstantSpeedPropagationDelayModel::Speed=3e10"
NEAR_NS = 8_000  # less than a slot
UNDECIDED_NS = 3_000_000  # at the end: frames that ns-3 has not finished
AT_ONCE_NS = 1_000
UNLUCKY = 1e-3  # a patience: a header survives where it could be detected, but no payload that ns-3 has lost
LUCKY = 1.0 - 2.0**-53  # for acknowledgements, as the chance of less

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
    (Case("g-54", 5, 0, saturated=True, unicast=True), 0.1),
    (Case("a-54", 5, 0, saturated=True, unicast=True), 0.1),
    (Case("b-11", 5, 0, saturated=True, unicast=True), 0.2),
    (Case("g-54", 50, 100), 0.2),
)


class Judged(NamedTuple):
    """Results of ns-3."""

    frames: Frames
    last_ns: Ints  # (f,) begin of the last attempt
    draws: list[list[float]]  # of each radio, as numbers from 0 to 1
    doubts: list[list[float]]  # beside each: small if used for a lost acknowledgement
    patience: list[list[Floats]]  # of each frame for each attempt, (n,)


def replay(case: Case, duration_s: float, seed: int = 1) -> tuple[int, int]:
    """Number of frames that agree, and number of all."""
    judged = _judge(case, duration_s, seed)
    decided = _ours(case, judged, round(duration_s * SECOND_NS) - UNDECIDED_NS)
    numbers = [number for number in decided if judged.frames.attempts[number] > 0]
    return sum(_same(decided[number], judged.frames, number, int(judged.last_ns[number])) for number in numbers), len(numbers)


def _same(ours: Decided, frames: Frames, number: int, last_ns: int) -> bool:
    received = frames.delay_ns[number] >= 0
    intended = (
        np.arange(len(received)) == frames.to[number]
        if frames.to[number] >= 0
        else np.arange(len(received)) != frames.sender[number]
    )
    if ours.attempts != frames.attempts[number] or abs(ours.start_ns - last_ns) > NEAR_NS:
        return False
    return bool(((ours.fate == Fate.RECEIVED) & intended == received).all())


def _lists(count: int) -> list[list[Any]]:
    return [[] for _ in range(count)]


def _judge(case: Case, duration_s: float, seed: int) -> Judged:
    stem = program.folder() / f"replay-{case.name}"
    places, out = stem.with_suffix(".csv"), stem.with_suffix(".bin")
    places.write_text("".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in case.positions.tolist()))
    options = case.ns3(seed) | {"duration": duration_s, "warmup": 0, "drain": 0, "log": 1}
    words = [f"--{name}={value}" for name, value in options.items()]
    command = [str(program.program()), f"--positions={places}", f"--out={out}", LIGHT, *words]
    log = subprocess.run(command, check=True, text=True, capture_output=True).stderr
    rows, n = np.fromfile(out, np.int64).reshape(-1, 7 + case.nodes), case.nodes
    numbers = {(sender, of_sender): number for number, (sender, of_sender) in enumerate(rows[:, :2].tolist())}
    draws, doubts, patience = _lists(n), _lists(n), _lists(len(rows))
    judged = Judged(program.read(Path(out), n), rows[:, 5], draws, doubts, patience)
    window, on_air, acked_ns = [0] * n, [-1] * n, [-SECOND_NS] * n
    ack_ns = Dcf().rules(Air(case, seed).phy, 1.0).cts_air_ns  # of the same length
    for line in log.splitlines():
        time, name, event, *more = line.split()
        node = int(name)
        if event == "cw":
            window[node] = int(more[0])
        elif event == "backoff":
            judged.draws[node].append((int(more[0]) + 0.5) / (window[node] + 1))
            judged.doubts[node].append(UNLUCKY)
        elif [event, *more] == ["tx", "control"]:  # the core also draws the success of an acknowledgement
            judged.draws[node].append(0.5)
            judged.doubts[node].append(UNLUCKY)
            acked_ns[node] = int(time)
        elif event == "tx":
            on_air[node] = numbers[node, int(more[0])]
            judged.patience[on_air[node]].append(np.full(n, UNLUCKY))
        elif [event, *more] == ["decoded", "control"]:
            answerer = (node + 1) % n
            if int(time) - acked_ns[answerer] < ack_ns + AT_ONCE_NS:  # else another frame's
                judged.doubts[answerer][-1] = LUCKY
        elif event == "decoded":
            judged.patience[on_air[int(more[0])]][-1][node] = np.inf
    return judged


def _ours(case: Case, judged: Judged, until_ns: int) -> dict[int, Decided]:
    """The core's results for the same frames, by number."""
    air, n, frames = Air(case, seed=1), case.nodes, judged.frames
    store = np.full((n, max(map(len, judged.draws)) + 1_000, 2), 0.5)
    for radio, pairs in enumerate(zip(judged.draws, judged.doubts, strict=True)):
        store[radio, : len(pairs[0])] = np.transpose(pairs)

    def uniform(keys: Any, numbers: Any, _slot: int) -> Floats:
        radio, number = np.broadcast_arrays(keys, numbers)
        return store[radio.astype(int), np.minimum(number.astype(int), store.shape[1] - 1)]

    def luck(sender: int, tries: Sequence[Floats], attempt: int, _start_ns: int) -> tuple[Floats, Floats]:
        return air.mean_mw[sender], tries[attempt] if attempt < len(tries) else np.full(n, UNLUCKY)

    with mock.patch("vcmvsp.netsim.mac.dcf.medium.link_uniform", uniform):
        medium = air.open(np.arange(n, dtype=np.uint64))
        for number, (sender, to, sent_ns) in enumerate(np.stack([frames.sender, frames.to, frames.sent_ns], axis=1).tolist()):
            renew = partial(luck, sender, judged.patience[number])
            medium.offer(Offered(number, sent_ns, sender, to, SIZE, 0, None, None, renew))
        return {each.number: each for each in medium.advance(until_ns)}


def main() -> int:
    """Print a line for each network; 1 if a frame disagrees."""
    agree = True
    for case, duration_s in CASES:
        same, frames = replay(case, duration_s)
        agree = agree and same == frames
        print(f"{case.name:40} {same:6} of {frames:6} frames agree", flush=True)
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
