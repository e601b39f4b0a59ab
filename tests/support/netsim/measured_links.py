"""Simulated measurement logs of a known radio, and the error of an estimate."""

import math

import numpy as np

from tests.support.netsim.channels import Line
from vcmvsp.netsim.calibration.measurements import MeasuredLinks
from vcmvsp.netsim.calibration.result import ParameterEstimate
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.path_loss import LogDistance
from vcmvsp.netsim.propagation.shadowing import Shadowing
from vcmvsp.physics.world.solids import Box

BOXES = (
    Box(center=(50.0, 25.0, 5.0), size=(0.2, 50.0, 10.0), material="concrete"),
    Box(center=(25.0, 50.0, 5.0), size=(50.0, 0.1, 10.0), material="plasterboard"),
    Box(center=(75.0, 50.0, 5.0), size=(50.0, 0.1, 10.0), material="plasterboard"),
    Box(center=(500.0, 500.0, 5.0), size=(1.0, 1.0, 10.0), material="wood"),
)


def points(rng: np.random.Generator, count: int, side_m: float = 100.0) -> Floats:
    """Positions in a square, 1 m above the ground."""
    return np.column_stack([rng.uniform(0.0, side_m, (count, 2)), np.ones(count)])


def tour(count: int, side_m: float = 60.0) -> Floats:
    """A path to and fro in lanes 10 m apart."""
    lane, along = np.divmod(np.linspace(0.0, 6.999, count), 1.0)
    x = side_m * np.where(lane % 2 == 0, along, 1.0 - along)
    return np.column_stack([x, 10.0 * lane, np.ones(count)])


def links(a: Floats, b: Floats, level: Floats, sensitivity_dbm: float = -math.inf) -> MeasuredLinks:
    return MeasuredLinks(0.1 * np.arange(len(a), dtype=np.float64), a, b, np.where(level < sensitivity_dbm, np.nan, level))


def mean_of(a: Floats, b: Floats, level_dbm: float = -40.0, exponent: float = 3.0) -> Floats:
    return level_dbm - LogDistance(exponent, 1.0, 0.0).loss_db(Line.between(a, b))


def shadows(a: Floats, b: Floats, seed: int, layer: Shadowing) -> Floats:
    return np.concatenate([layer.loss_db(Line.between(a[i], b[i : i + 1], seed)) for i in range(len(a))])


def normal_score(found: ParameterEstimate | None, truth: float) -> float:
    """Error in standard errors; for positive quantities, by the logarithm."""
    assert found is not None
    if found.naive_error is None:
        return math.log(found.value / truth) / (found.standard_error / found.value)
    return (found.value - truth) / found.standard_error
