"""Data of the calibration figure: levels over distance, and the correlation of neighbouring rows."""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.netsim.calibration.covariance import moved_m
from vcmvsp.netsim.calibration.design_matrix import design_of, sample
from vcmvsp.netsim.calibration.measurement_log import MeasuredLinks
from vcmvsp.netsim.calibration.result import Calibration
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.walls import Sightline

_ROWS = 1500  # of which all pairs are looked at
_PARTS = 24  # intervals of displacement
_PAIRS = 30  # that an interval needs to be shown


class FigureData(NamedTuple):
    """Arguments of `cosim.plots.radio_plots.draw_calibration`, which says what each is."""

    distance_m: Floats
    level_dbm: Floats
    line_m: Floats
    line_dbm: Floats
    sigma_db: float
    sensitivity_dbm: float | None
    walls: bool
    moved_m: Floats
    correlation: Floats
    curve_m: Floats
    curve: Floats
    correlation_distance_m: float | None


def figure_data(links: MeasuredLinks, calibration: Calibration, sightline: Sightline | None) -> FigureData:
    """Measured levels without their walls, fitted line, measured and fitted correlation."""
    shown = links.only(sample(links, _ROWS))
    design, materials = design_of(shown, calibration.reference_distance_m, sightline)
    losses = [calibration.walls_db[name].value if name in calibration.walls_db else 0.0 for name in materials]
    open_air = shown.level_dbm - design[:, 2:] @ np.array(losses)
    line = design[:, :2] @ (calibration.level_dbm.value, calibration.exponent.value)

    reach = calibration.correlation_distance_m
    told = reach is not None and math.isfinite(reach.standard_error)
    far = 4.0 * reach.value if told and reach is not None else 20.0 * max(calibration.spacing_m, 0.1)
    middles, correlation = _correlogram(shown, open_air - line, far)
    curve_m = np.linspace(0.0, far, 200)
    fading = 0.0 if calibration.fading_db is None else calibration.fading_db.value
    share = (fading / calibration.deviation_db) ** 2
    along = np.geomspace(max(1e-3, shown.distance_m.min()), shown.distance_m.max(), 200)
    decades = np.log10(np.maximum(along / calibration.reference_distance_m, 1.0))
    return FigureData(
        distance_m=shown.distance_m,
        level_dbm=open_air,
        line_m=along,
        line_dbm=calibration.level_dbm.value - 10.0 * calibration.exponent.value * decades,
        sigma_db=calibration.deviation_db,
        sensitivity_dbm=calibration.sensitivity_dbm,
        walls=bool(calibration.walls_db),
        moved_m=middles,
        correlation=correlation,
        curve_m=curve_m,
        curve=(1.0 - share) * np.exp(-curve_m / reach.value) if reach is not None else np.zeros(0),
        correlation_distance_m=None if reach is None else reach.value,
    )


def _correlogram(links: MeasuredLinks, residual: Floats, far_m: float) -> tuple[Floats, Floats]:
    """Correlation of the residuals of received rows by how far the ends moved, both (k,)."""
    rows = np.flatnonzero(~links.lost)
    received = links.only(rows)
    deviation = residual[rows] - residual[rows].mean()
    first, second = np.triu_indices(len(rows), k=1)
    part = np.floor(moved_m(received.a, received.b)[first, second] / far_m * _PARTS).astype(int)
    near = part < _PARTS
    pairs = np.bincount(part[near], minlength=_PARTS)
    products = np.bincount(part[near], (deviation[first] * deviation[second])[near], minlength=_PARTS)
    correlation = np.where(pairs >= _PAIRS, products / np.maximum(pairs, 1) / max(deviation.var(), 1e-12), np.nan)
    return (np.arange(_PARTS) + 0.5) * far_m / _PARTS, correlation
