"""Calibration: path loss, shadowing, walls and fading from a measured log (``vcmvsp calibrate LINKS.csv``).

`read_links` reads the log, `fit` estimates the parameters; the statistical model is in `netsim.calibration.likelihood`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.errors import UsageError
from vcmvsp.netsim.calibration.likelihood import (
    CORRELATED,
    INDEPENDENT,
    WITH_FADING,
    FittedModel,
    Survey,
    aic_of,
    climb,
    log_likelihood,
    maximise,
    moved_m,
    restricted,
    spreads,
)
from vcmvsp.netsim.calibration.measurements import MeasuredLinks, design_of, read_links, require_told, sample
from vcmvsp.netsim.calibration.result import Calibration, ParameterEstimate, RayCalibration
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.walls import Sightline

MOST_ROWS = 1000  # fitted rows: the cost grows with the third power of their number
MODELS = {INDEPENDENT: "independent", CORRELATED: "correlated", WITH_FADING: "correlated, fading"}
_WEAKER = 0.05  # largest share of received rows below the sensitivity: real radios have no sharp threshold
_SCOUTS = 300  # rows in the search for starting values


def fit(
    links: MeasuredLinks,
    *,
    tx_power_dbm: float = 0.0,
    reference_distance_m: float = 1.0,
    sensitivity_dbm: float | None = None,
    sightline: Sightline | None = None,
) -> Calibration:
    """Fit the mean model to a log by maximum likelihood, with standard errors.

    Three models of the variation are fitted: independent rows; a shadowing field; a shadowing field and independent fading.
    Standard errors come from the observed information of the joint likelihood of all rows, so they account for correlation of
    neighbouring rows. Intervals of level, exponent and walls use Student's t with Satterthwaite's degrees of freedom
    (F. Satterthwaite, Biometrics Bulletin 2, 1946).

    Args:
        links: the log; a sample of it if it has more than `MOST_ROWS` rows.
        tx_power_dbm: transmitted power, antenna gains included.
        reference_distance_m: distance of the reference level; the level is constant below it.
        sensitivity_dbm: the level below which a frame is lost; None: the lowest received level.
        sightline: the walls; the loss of each crossed material is fitted.

    Raises:
        UsageError: the rows do not determine the parameters.
    """
    if links.lost.all():
        raise UsageError("no row has a received level: there is nothing to fit")
    if not reference_distance_m > 0.0:
        raise UsageError(f"the reference distance is {reference_distance_m:g} m; it must be > 0")
    sensitivity_dbm = _sensitivity(links, sensitivity_dbm)
    used = links.only(sample(links, MOST_ROWS))
    design, materials = design_of(used, reference_distance_m, sightline)
    require_told(used, design, materials)
    levels: dict[str, Any] = {"level_dbm": used.level_dbm, "lost": used.lost, "design": design}
    survey = Survey.between(used.a, used.b, sensitivity_dbm=sensitivity_dbm, **levels)
    with threadpool_limits(1):  # small matrices: threads would mostly wait for each other
        models = _models(survey, survey.only(sample(used, _SCOUTS)))
        order = _choose(models, survey.nearest_m)
        best, naive = models[order], models[INDEPENDENT]
        aic = {MODELS[each]: model.aic for each, model in models.items()}
        aic["without distance"] = _without(survey, [1], best)
        if materials:
            aic["without walls"] = _without(survey, range(2, 2 + len(materials)), best)

    level, exponent, *walls = _coefficients(best, naive)
    spacing_m = float(np.median(survey.nearest_m))
    shadowing, reach, fading = _variation(best, spacing_m)
    margin = design @ best.coefficients - sensitivity_dbm
    deviation_db = math.exp(0.5 * best.parameters[0])
    return Calibration(
        level_dbm=level,
        exponent=exponent,
        walls_db=dict(zip(materials, walls, strict=True)),
        shadowing_db=shadowing,
        correlation_distance_m=reach,
        fading_db=fading,
        tx_power_dbm=tx_power_dbm,
        reference_distance_m=reference_distance_m,
        sensitivity_dbm=sensitivity_dbm if links.lost.any() else None,
        rows=len(links.level_dbm),
        used=len(used.level_dbm),
        lost=int(used.lost.sum()),
        spacing_m=spacing_m,
        log_likelihood=best.log_likelihood,
        aic=aic,
        model=MODELS[order],
        unexplained=int((margin[used.lost] > 3.0 * deviation_db).sum()),
    )


def fit_rays(
    links: MeasuredLinks, loss_db: Callable[[Floats, Floats], Floats], path_loss: dict[str, Any], **options: Any
) -> RayCalibration:
    """Fit an offset of the levels that rays give, and what is left, to a log, and log-distance to the same rows.

    Args:
        links: the log.
        loss_db: loss between points (n, 3) m and (n, 3) m, (n,).
        path_loss: the table of the rays, for the result.
        options: of `fit`.

    Raises:
        UsageError: see `fit`.
    """
    log_distance = fit(links, **options)
    sensitivity_dbm = _sensitivity(links, log_distance.sensitivity_dbm)
    used = links.only(sample(links, MOST_ROWS))
    computed_dbm = log_distance.tx_power_dbm - loss_db(used.a, used.b)
    levels: dict[str, Any] = {"level_dbm": used.level_dbm - computed_dbm, "lost": used.lost}
    levels |= {"sensitivity_dbm": sensitivity_dbm - computed_dbm, "design": np.ones((len(used.lost), 1))}
    survey = Survey.between(used.a, used.b, **levels)
    with threadpool_limits(1):
        models = _models(survey, survey.only(sample(used, _SCOUTS)))
    best, naive = models[_choose(models, survey.nearest_m)], models[INDEPENDENT]
    (offset,) = _coefficients(best, naive)
    shadowing, reach, fading = _variation(best, log_distance.spacing_m)
    return RayCalibration(
        offset_db=offset,
        shadowing_db=shadowing,
        correlation_distance_m=reach,
        fading_db=fading,
        path_loss=path_loss,
        aic=best.aic,
        log_distance=log_distance,
    )


def calibrate_file(path: Path, fitted: Callable[..., Any] = fit, **options: Any) -> tuple[MeasuredLinks, Any]:
    """Read a log file and fit it (`fit`, `fit_rays`) with these options; errors name the file."""
    links = read_links(path)
    try:
        return links, fitted(links, **options)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error


def _sensitivity(links: MeasuredLinks, sensitivity_dbm: float | None) -> float:
    """The given sensitivity, if the received rows allow it, or the lowest received level."""
    least_dbm = float(np.nanmin(links.level_dbm))
    if sensitivity_dbm is None:
        return least_dbm
    weaker = float((links.level_dbm[~links.lost] < sensitivity_dbm).mean())
    if weaker > _WEAKER:
        raise UsageError(
            f"sensitivity {sensitivity_dbm:g} dBm: {weaker:.0%} of the received rows are weaker, down to {least_dbm:g}"
        )
    return sensitivity_dbm


def _coefficients(best: FittedModel, naive: FittedModel) -> list[ParameterEstimate]:
    """Estimates of the mean's coefficients."""
    errors, naive_errors = (np.sqrt(np.diagonal(each.coefficients_spread)).tolist() for each in (best, naive))
    rows = zip(best.coefficients.tolist(), errors, naive_errors, best.freedom.tolist(), strict=True)
    return [ParameterEstimate.of_mean(*row) for row in rows]


def _models(survey: Survey, scouts: Survey) -> dict[int, FittedModel]:
    """Fitted models of the variation, by number of parameters; ``scouts``: few rows, to search for starting values."""
    independent = maximise(survey, np.array([np.mean(survey.limits[0])]))
    scale = independent.parameters[0]
    starts = [np.array([scale, reach, share]) for reach in np.linspace(*survey.limits[1], 7)[:-1] for share in (-2.0, 0.0)]
    start = max(starts, key=lambda each: restricted(scouts, each).log_likelihood)
    fading = maximise(survey, start)
    correlated = maximise(survey, fading.parameters[:CORRELATED])
    return {INDEPENDENT: independent, CORRELATED: correlated, WITH_FADING: fading}


def _choose(models: dict[int, FittedModel], nearest_m: Floats) -> int:
    """Select a model: correlated if its AIC is lower; with fading if the rows can separate it from shadowing.

    They can if a quarter of them have a neighbour within the correlation distance. A significance test of the fading would
    turn weak fading into a short correlation distance.
    """
    is_separable = np.quantile(nearest_m, 0.25) < math.exp(models[WITH_FADING].parameters[1])
    order = WITH_FADING if is_separable else CORRELATED
    return order if models[order].aic < models[INDEPENDENT].aic else INDEPENDENT


def _without(survey: Survey, columns: Sequence[int], best: FittedModel) -> float:
    """AIC of the model ``best`` without these columns of the mean."""
    fewer = replace(survey, design=np.delete(survey.design, list(columns), axis=1))
    parameters = climb(fewer, best.parameters)
    coefficients = restricted(fewer, parameters).coefficients
    return aic_of(len(parameters) + len(coefficients), log_likelihood(fewer, parameters, coefficients))


def _variation(
    best: FittedModel, spacing_m: float
) -> tuple[ParameterEstimate | None, ParameterEstimate | None, ParameterEstimate | None]:
    """Estimates of shadowing, correlation distance and fading; None: not part of the model."""
    logs, slopes = spreads(best.parameters)
    errors = [_error(slope, best.parameters_spread) for slope in slopes]
    spread = [ParameterEstimate.positive(math.exp(log), error) for log, error in zip(logs.tolist(), errors, strict=True)]
    if len(best.parameters) == INDEPENDENT:  # variation at one place is fading
        return (None, None, spread[0]) if spacing_m == 0.0 else (spread[0], None, None)
    reach = ParameterEstimate.positive(
        math.exp(best.parameters[1]), _error(np.eye(len(best.parameters))[1], best.parameters_spread)
    )
    return spread[0], reach, spread[1] if len(best.parameters) == WITH_FADING else None


def _error(slope: Floats, spread: Floats) -> float:
    counts = slope != 0.0
    return math.sqrt(slope[counts] @ spread[np.ix_(counts, counts)] @ slope[counts])


_ROWS = 1500  # largest number of rows whose pairs are all evaluated
_PARTS = 24  # intervals of displacement
_PAIRS = 30  # least number in an interval of the figure


def figure_data(links: MeasuredLinks, calibration: Calibration, sightline: Sightline | None) -> dict[str, Any]:
    """Arguments of `cosim.plots.radio_plots.draw_calibration`: levels without walls, fitted line, correlations."""
    subset = links.only(sample(links, _ROWS))
    design, materials = design_of(subset, calibration.reference_distance_m, sightline)
    losses_db = {name: loss.value for name, loss in calibration.walls_db.items()}
    losses = [losses_db.get(name, 0.0) for name in materials]
    open_air = subset.level_dbm - design[:, 2:] @ np.array(losses)
    line = design[:, :2] @ (calibration.level_dbm.value, calibration.exponent.value)

    reach = calibration.correlation_distance_m
    far = 20.0 * max(calibration.spacing_m, 0.1)
    if reach is not None and math.isfinite(reach.standard_error):
        far = 4.0 * reach.value
    middles, correlation = _correlogram(subset, open_air - line, far)
    curve_m, curve = np.linspace(0.0, far, 200), np.zeros(0)
    if reach is not None:
        fading_db = 0.0 if calibration.fading_db is None else calibration.fading_db.value
        curve = (1.0 - (fading_db / calibration.deviation_db) ** 2) * np.exp(-curve_m / reach.value)
    along = np.geomspace(max(1e-3, subset.distance_m.min()), subset.distance_m.max(), 200)
    decades = np.log10(np.maximum(along / calibration.reference_distance_m, 1.0))
    return {
        "distance_m": subset.distance_m,
        "level_dbm": open_air,
        "line_m": along,
        "line_dbm": calibration.level_dbm.value - 10.0 * calibration.exponent.value * decades,
        "sigma_db": calibration.deviation_db,
        "sensitivity_dbm": calibration.sensitivity_dbm,
        "walls": bool(calibration.walls_db),
        "moved_m": middles,
        "correlation": correlation,
        "curve_m": curve_m,
        "curve": curve,
        "correlation_distance_m": None if reach is None else reach.value,
    }


def _correlogram(links: MeasuredLinks, residual: Floats, far_m: float) -> tuple[Floats, Floats]:
    """Displacements of both ends, and correlations of the residuals of received rows there, (k,) each."""
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
