"""The rows of a log that are fitted, and what the mean of each is made of."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.rng import stream
from vcmvsp.netsim.calibration.measurement_log import MeasuredLinks
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.walls import Sightline


def sample(links: MeasuredLinks, most: int) -> NDArray[np.intp]:
    """Numbers of at most so many rows: half of them spread evenly over the log, and the nearest neighbour of each.

    Spread rows tell of the mean, near ones of correlation and fading (P. Diggle, S. Lophaven, Bayesian geostatistical design,
    Scandinavian Journal of Statistics 33, 2006). What is left out adds little: it shares the shadowing of what is taken.
    """
    from scipy.spatial import cKDTree

    count = len(links.level_dbm)
    if count <= most:
        return np.arange(count)
    parts = np.linspace(0.0, count, most // 2 + 1)
    spread = (parts[:-1] + np.diff(parts) * stream(0, "calibrate/sample").random(most // 2)).astype(int)  # one of each part
    ends = np.concatenate([np.hstack([links.a, links.b]), np.hstack([links.b, links.a])])  # both ways round
    near = np.asarray(cKDTree(ends).query(ends[spread], k=2)[1])
    near %= count  # a row whose ends are at one point may find itself twice, and then stands alone
    return np.union1d(spread, np.where(near[:, 0] == spread, near[:, 1], near[:, 0]))


def crossings(links: MeasuredLinks, sightline: Sightline) -> tuple[Floats, list[str]]:
    """How many walls of each material each row crosses, (n, m), and the materials, of walls that are crossed at all."""
    crossed = np.zeros((len(links.a), len(sightline.materials)))
    start, group = np.unique(links.a, axis=0, return_inverse=True)
    for index, point in enumerate(start):
        rows = group.ravel() == index
        crossed[rows] = sightline.crossings(point, links.b[rows])[0]
    found = sorted({sightline.materials[index] for index in np.flatnonzero(crossed.any(axis=0))})
    of = np.array([[name == each for each in found] for name in sightline.materials], np.float64).reshape(-1, len(found))
    return crossed @ of, found


def design_of(links: MeasuredLinks, reference_distance_m: float, sightline: Sightline | None) -> tuple[Floats, list[str]]:
    """What the level at the reference distance, the exponent and each material's loss are multiplied with, (n, 2 + m)."""
    ratio = np.maximum(links.distance_m, reference_distance_m) / reference_distance_m
    walls, materials = (np.zeros((len(ratio), 0)), []) if sightline is None else crossings(links, sightline)
    return np.column_stack([np.ones(len(ratio)), -10.0 * np.log10(ratio), -walls]), materials


def require_told(links: MeasuredLinks, design: Floats, materials: Sequence[str]) -> None:
    """Refuse rows that leave a coefficient of the mean open.

    Args:
        links: n rows.
        design: as of `design_of`, (n, 2 + m).
        materials: of its last m columns.

    Raises:
        UsageError: which coefficient it is, and what to measure.
    """
    received = design[~links.lost]
    if len(received) < design.shape[1] + 2:
        raise UsageError(f"{len(received)} rows were received; {design.shape[1]} numbers need at least {design.shape[1] + 2}")
    if np.ptp(received[:, 1]) < 1e-6:
        distance = float(links.distance_m[~links.lost].mean())
        raise UsageError(
            f"all received rows are at one distance ({distance:.4g} m), or nearer than the reference distance: the exponent is "
            "not identifiable; measure at several distances"
        )
    for material, column in zip(materials, received[:, 2:].T, strict=True):
        if not column.any():
            raise UsageError(
                f"walls of {material} are crossed by lost rows only, which do not tell their loss: leave those rows out"
            )
    if np.linalg.matrix_rank(received / np.linalg.norm(received, axis=0), tol=1e-6) < design.shape[1]:
        raise UsageError(
            f"the losses of walls of {', '.join(materials)} cannot be told apart, or not from level and exponent: measure with "
            "and without each in the way"
        )
