"""How well the radio connects the vehicles: algebraic connectivity of who heard whom.

In each second of the window the graph has an edge between two vehicles if either received a frame of the other in it. The
algebraic connectivity is the second smallest eigenvalue of its Laplacian (Fiedler, Czechoslovak Mathematical Journal 23,
1973): 0 where the graph falls into parts, N where everybody heard everybody, 1 for a star, 2 (1 - cos(pi/N)) for a path.
The rate at which a consensus converges is in proportion to it. Every vehicle of the run counts, whether it sends or not; a
message that is sent less than once a second leaves seconds without an edge.
"""

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.radio import Receptions
from vcmvsp.cosim.metrics.window import Window, window_ns
from vcmvsp.cosim.types import Array

SPAN_NS = SECOND_NS  # one graph is of so much time
MOST_VEHICLES = 200  # of more, eigenvalues would take longer than the run
AT_ONCE = 1 << 20  # entries of the matrices that are held in memory together
DECIMALS = 9  # to which eigenvalues are the same on any machine


def connectivity_metrics(got: Receptions, vehicles: Sequence[str], window: Window, end_ns: int) -> dict[str, float | None]:
    """The ``connectivity`` part; None for one vehicle alone, more than `MOST_VEHICLES`, or a window shorter than `SPAN_NS`."""
    begin, last = window_ns(window)
    graphs = (min(last, end_ns) - begin) // SPAN_NS
    if not 2 <= len(vehicles) <= MOST_VEHICLES or graphs < 1:
        return dict.fromkeys(("mean", "min", "connected_share"))
    values = algebraic_connectivity(adjacency(got, vehicles, begin, graphs))
    return {"mean": float(values.mean()), "min": float(values.min()), "connected_share": float((values > 0.0).mean())}


def adjacency(got: Receptions, vehicles: Sequence[str], begin_ns: int, graphs: int) -> Array:
    """Who heard whom in each of so many seconds, either way: (graphs, n, n) bool."""
    n, number = len(vehicles), {name: i for i, name in enumerate(vehicles)}
    to, by = (
        np.array([number[name] for name in names], np.int64)[codes]
        for names, codes in ((got.receivers, got.to), (got.senders, got.by))
    )
    when = (got.received_ns - begin_ns) // SPAN_NS
    counted = (when >= 0) & (when < graphs)
    heard = np.zeros(graphs * n * n, np.bool_)
    heard[((when * n + to) * n + by)[counted]] = True
    either = heard.reshape(graphs, n, n)
    return either | either.transpose(0, 2, 1)


def algebraic_connectivity(adjacent: Array) -> Array:
    """Second smallest eigenvalues (m,) of the Laplacians of undirected graphs (m, n, n), n >= 2."""
    m, n, _ = adjacent.shape
    values = np.empty(m)
    step = max(1, AT_ONCE // n**2)
    with threadpool_limits(1):  # sums come out the same on any number of cores
        for first in range(0, m, step):
            some = adjacent[first : first + step].astype(np.float64)
            laplacian = -some
            laplacian[:, range(n), range(n)] += some.sum(axis=2)
            values[first : first + step] = np.linalg.eigvalsh(laplacian)[:, 1]
    return np.round(values, DECIMALS) + 0.0  # no -0.0
