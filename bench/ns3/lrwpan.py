"""IEEE 802.15.4 CSMA/CA beside ns-3.44 with equal frames and places: ``python -m bench.ns3.lrwpan``.

For each network the share of receptions and the mean delay of both, and the CPU time per transmission. Needs the wheel of
`bench.ns3.program`.
"""

import hashlib
import json
import subprocess
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.ns3 import program
from vcmvsp.cosim.rng import key64
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Offered, Renew
from vcmvsp.netsim.mac.csma154.medium import Csma154
from vcmvsp.netsim.phy.ieee802154 import Ieee802154

SOURCE = program.SOURCE.with_name("lrwpan.cc")
LIBRARIES = ("lr-wpan", "core", "network", "propagation", "spectrum", "mobility", "antenna", "stats", "energy")

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Network(NamedTuple):
    """Nodes and their frames."""

    positions: Floats  # (n, 3) m
    offers: Ints  # (f, 4) time ns, sender, receiver (-1: all), payload bytes; by time
    exponent: float = 3.0  # of the path loss, 40.052 dB at 1 m
    sensitivity_dbm: float = -85.0


class Outcome(NamedTuple):
    """Outcomes of f frames."""

    start_ns: Ints  # (f,) last attempt; -1: never
    end_ns: Ints  # (f,) decided
    attempts: Ints  # (f,)
    received_ns: Ints  # (f, n) -1: not
    cpu_s: float

    def pdr(self, network: Network) -> float:
        """Share of received frames x intended receivers."""
        unicast = int((network.offers[:, 2] >= 0).sum())
        intended = unicast + (len(self.end_ns) - unicast) * (len(network.positions) - 1)
        return self.received(network).size / intended

    def received(self, network: Network) -> Floats:
        """Delays of all receptions at intended receivers, s."""
        to = network.offers[:, 2:3]
        arrived = (self.received_ns >= 0) & ((to < 0) | (to == np.arange(len(network.positions))))
        delay_ns: Ints = (self.received_ns - network.offers[:, :1])[arrived]
        return delay_ns / 1e9


def periodic(nodes: int, hz: float, size: int, duration_s: float, seed: int, *, unicast: bool = False) -> Ints:
    """Every node sends at this rate with a random phase; unicast frames go to a random other node each."""
    rng = np.random.default_rng(seed)
    period_ns = round(1e9 / hz)
    rows = []
    for node in range(nodes):
        times = 1_000_000_000 + int(rng.integers(period_ns)) + period_ns * np.arange(round(duration_s * hz))
        to = (node + rng.integers(1, nodes, len(times))) % nodes if unicast else np.full(len(times), -1)
        rows.append(np.stack([times, np.full(len(times), node), to, np.full(len(times), size)], axis=1))
    every = np.concatenate(rows)
    return every[np.argsort(every[:, 0], kind="stable")]


def judge(network: Network, seed: int) -> Outcome:
    """Run ns-3."""
    place = program.folder() / f"lrwpan-{seed}"
    nodes, frames, out = (place.with_suffix(suffix) for suffix in (".nodes", ".frames", ".bin"))
    nodes.write_text("".join(f"{x!r},{y!r},{z!r}\n" for x, y, z in network.positions.tolist()))
    frames.write_text("".join(f"{a},{b},{c},{d}\n" for a, b, c, d in network.offers.tolist()))
    words = [f"--positions={nodes}", f"--offers={frames}", f"--out={out}", f"--seed={seed}"]
    words += [f"--exponent={network.exponent}", f"--sensitivity={network.sensitivity_dbm}"]
    result = subprocess.run([str(_program()), *words], check=True, text=True, stdout=subprocess.PIPE)
    rows = np.fromfile(out, np.int64).reshape(-1, 7 + len(network.positions))
    return Outcome(rows[:, 3], rows[:, 4], rows[:, 5], rows[:, 7:], json.loads(result.stdout)["cpu_s"])


def ours(network: Network, seed: int, mac: Csma154 | None = None) -> Outcome:
    """Run `Csma154` alone."""
    count, frames = len(network.positions), len(network.offers)
    offset = network.positions[:, None] - network.positions[None]
    distance = np.maximum(np.sqrt((offset**2).sum(axis=2)), 1.0)
    phy = Ieee802154(sensitivity_dbm=network.sensitivity_dbm)
    power_mw = 10.0 ** ((phy.tx_power_dbm - 40.052 - 10.0 * network.exponent * np.log10(distance)) / 10.0)
    keys = np.array([key64(seed, str(row)) for row in range(count)], np.uint64)
    rng = np.random.default_rng(seed)

    def renewal(sender: int) -> Renew:
        return lambda _attempt, _start_ns: (power_mw[sender], rng.standard_exponential(count))

    begin = time.process_time()
    medium = (mac or Csma154()).open(phy, count, keys, 10.0 ** (phy.noise_dbm / 10.0))
    decided: list[Decided] = []
    for number, (time_ns, sender, to, size) in enumerate(network.offers.tolist()):
        decided += medium.advance(time_ns - 1)
        patience = rng.standard_exponential(count)
        medium.offer(Offered(number, time_ns, sender, to, size, 0, power_mw[sender], patience, renewal(sender)))
    decided += medium.advance(int(network.offers[-1, 0]) + 2_000_000_000)
    cpu_s = time.process_time() - begin

    start_ns, end_ns, attempts = np.full((3, frames), -1, np.int64)
    received_ns = np.full((frames, count), -1, np.int64)
    for each in decided:
        start_ns[each.number], end_ns[each.number], attempts[each.number] = each.start_ns, each.end_ns, each.attempts
        to = int(network.offers[each.number, 2])
        received = each.fate == Fate.RECEIVED if to < 0 else (np.arange(count) == to) & (each.fate == Fate.RECEIVED)
        received_ns[each.number, received] = each.end_ns
    return Outcome(start_ns, end_ns, attempts, received_ns, cpu_s)


def main() -> None:
    """The table."""
    rng = np.random.default_rng(7)

    def square(nodes: int, side_m: float) -> Floats:
        return np.concatenate([rng.uniform(0.0, side_m, (nodes, 2)), np.zeros((nodes, 1))], axis=1)

    cases = [
        ("one domain", nodes, hz, size, 10.0, 2.0, False)
        for nodes in (5, 20, 50)
        for hz, size in ((1.0, 100), (10.0, 20), (10.0, 100))
    ]
    cases += [
        ("wide field", nodes, hz, 100, side, 3.0, False)
        for nodes, hz, side in ((20, 10.0, 80.0), (50, 2.0, 150.0), (50, 10.0, 150.0))
    ]
    cases += [("unicast", nodes, hz, 50, 10.0, 2.0, True) for nodes, hz in ((5, 5.0), (20, 2.0), (20, 5.0))]
    print("| network | nodes | Hz | bytes | PDR ns-3 | ours | delay ms ns-3 | ours | us a transmission ns-3 | ours |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for seed, (name, nodes, hz, size, side_m, exponent, unicast) in enumerate(cases):
        duration_s = max(4.0, min(60.0, 4000.0 / (nodes * hz)))
        offers = periodic(nodes, hz, size, duration_s, seed, unicast=unicast)
        network = Network(square(nodes, side_m), offers, exponent)
        judge_outcome, our_outcome = judge(network, seed + 1), ours(network, seed)
        delays = [1e3 * float(each.received(network).mean()) for each in (judge_outcome, our_outcome)]
        costs = [1e6 * each.cpu_s / max(1, int(each.attempts.sum())) for each in (judge_outcome, our_outcome)]
        print(
            f"| {name} | {nodes} | {hz:g} | {size} | {judge_outcome.pdr(network):.4f} | {our_outcome.pdr(network):.4f} "
            f"| {delays[0]:.3f} | {delays[1]:.3f} | {costs[0]:.0f} | {costs[1]:.0f} |",
            flush=True,
        )


def _program() -> str:
    target = program.folder() / f"lrwpan-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:12]}"
    if not target.exists():
        ns3 = program._prefix()
        libraries = [f"-lns3.44-{name}" for name in LIBRARIES]
        command = ["g++", "-O2", "-std=c++20", f"-I{ns3}/include", str(SOURCE), "-o", str(target), f"-L{ns3}/lib64", *libraries]
        subprocess.run([*command, f"-Wl,-rpath,{ns3}/lib64", "-Wl,--allow-shlib-undefined"], check=True)
    return str(target)


if __name__ == "__main__":
    main()
