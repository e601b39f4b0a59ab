"""Result of a calibration: estimates, scenario table and text summary."""

import math
from typing import Any, Self

import msgspec

_WITHIN = 1.96  # standard errors of a normal estimate on either side: 95 %
_DB = 10.0 / math.log(10.0)
_NAKAGAMI = (0.1, 1000.0)  # shapes that `netsim.propagation.fading.Nakagami` takes


class ParameterEstimate(msgspec.Struct, frozen=True):
    """Estimate of a parameter, and its uncertainty."""

    value: float
    standard_error: float  # infinite: the rows do not determine it
    low: float  # 95 % interval
    high: float
    naive_error: float | None = None  # standard error if all rows were independent

    @classmethod
    def of_mean(cls, value: float, standard_error: float, naive_error: float, freedom: float = math.inf) -> Self:
        """Estimate of a coefficient of the mean; ``freedom``: degrees of freedom of its standard error."""
        from scipy.special import stdtrit

        margin = _WITHIN if freedom > 1e6 else float(stdtrit(max(1.0, freedom), 0.975))
        margin *= standard_error
        return cls(value, standard_error, value - margin, value + margin, naive_error)

    @classmethod
    def positive(cls, value: float, relative_error: float) -> Self:
        """Estimate of a spread or a length, whose logarithm is nearer to normal."""
        if not math.isfinite(relative_error):
            return cls(value, math.inf, 0.0, math.inf)
        factor = math.exp(min(_WITHIN * relative_error, 700.0))
        return cls(value, value * relative_error, value / factor, value * factor)


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """Maximum-likelihood mean model of a measured log.

    ``level = level_dbm - 10 exponent log10(max(d, reference_distance_m) / reference_distance_m) - walls - shadowing - fading``
    """

    level_dbm: ParameterEstimate  # Pd0, at the reference distance
    exponent: ParameterEstimate
    walls_db: dict[str, ParameterEstimate]  # per wall, by material
    shadowing_db: ParameterEstimate | None  # standard deviation; None: the level varies as much at one place as between places
    correlation_distance_m: ParameterEstimate | None  # None: rows are independent at all measured distances
    fading_db: ParameterEstimate | None  # the same at one place, with measurement error; None: not separated from shadowing
    tx_power_dbm: float
    reference_distance_m: float
    sensitivity_dbm: float | None  # None: no row was lost
    rows: int
    used: int  # fitted rows: of a long log a sample
    lost: int  # lost rows among the fitted ones
    spacing_m: float  # from a row to its nearest neighbour, both ends together; median
    log_likelihood: float
    aic: dict[str, float]  # Akaike's information criterion of this model and others: lower is better
    model: str  # which of them this is
    unexplained: int  # lost rows whose mean level is more than 3 deviations above the sensitivity: probably another cause

    @property
    def deviation_db(self) -> float:
        """Standard deviation of a single level about the mean."""
        return math.hypot(*(each.value for each in (self.shadowing_db, self.fading_db) if each is not None))

    def table(self) -> dict[str, Any]:
        """The ``[radio]`` table of a scenario with this radio: path_loss, shadowing, walls and fading, as far as estimated.

        Fading is given as Nakagami's distribution with the same variance in dB, ``(10 / ln 10)^2 psi'(m)``. Its mean power is
        1, so its mean in dB, ``10 / ln 10 (psi(m) - ln m)``, is below 0; ``reference_loss_db`` compensates.
        """
        if round(self.exponent.value, 4) < 0.0:
            raise ValueError(f"the exponent is {self.exponent.value:.2f}: levels rise with distance; no path-loss model fits")
        fading, mean_db = _fading(self.fading_db)
        path_loss = {
            "kind": "log_distance",
            "exponent": abs(round(self.exponent.value, 4)),
            "reference_distance_m": self.reference_distance_m,
            "reference_loss_db": round(self.tx_power_dbm + mean_db - self.level_dbm.value, 3),
        }
        shadowing = _shadowing(self.shadowing_db, self.correlation_distance_m, self.spacing_m)
        losses = {material: round(max(0.0, loss.value), 3) for material, loss in self.walls_db.items()}
        walls = {"walls": {"kind": "fixed", "materials_db": losses}} if losses else {}
        return {"path_loss": path_loss, **shadowing, **walls, **fading}

    def toml(self) -> str:
        """The table as TOML, with comments on its validity."""
        import tomli_w

        comments = [
            f"fitted to {self.used} of {self.rows} rows, {self.lost} of them lost, for tx_power_dbm = {self.tx_power_dbm:g}"
        ]
        if self.sensitivity_dbm is not None:
            comments.append(f"and sensitivity_dbm = {self.sensitivity_dbm:g} (set both in [radio.phy])")
        if self.walls_db:
            comments.append("walls of other materials have wall_db, 6.325 dB by default")
        if self.shadowing_db is not None and self.correlation_distance_m is None:
            comments.append("correlation_distance_m is an upper bound: rows this far apart show no correlation")
        return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps({"radio": self.table()})

    def summary(self) -> str:
        """A line for each number: estimate, 95 % interval, standard error; and the models that were compared."""
        below = "" if self.sensitivity_dbm is None else f" (below {self.sensitivity_dbm:g} dBm)"
        models = sorted(self.aic.items(), key=lambda item: item[1])
        lines = [
            f"{self.used} of {self.rows} rows, {self.lost} lost{below}",
            _line(f"level at {self.reference_distance_m:g} m", "dBm", self.level_dbm),
            _line("path-loss exponent", "", self.exponent),
            *[_line(f"wall of {material}", "dB", loss) for material, loss in self.walls_db.items()],
            *_variation_lines(self.shadowing_db, self.correlation_distance_m, self.fading_db),
        ]
        lines.append("AIC: " + ", ".join(f"{name} {value:.1f}" for name, value in models))
        if self.unexplained:
            lines.append(
                f"{self.unexplained} lost rows have an expected level far above the sensitivity: check them, or leave them out"
            )
        return "\n".join(lines)


class RayCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """Maximum-likelihood offset of a measured log from the levels by rays, beside log-distance fitted to the same rows.

    ``level = tx_power_dbm - loss of the rays + offset_db - shadowing - fading``
    """

    offset_db: ParameterEstimate  # measured levels less computed ones
    shadowing_db: ParameterEstimate | None  # what is left: see `Calibration`
    correlation_distance_m: ParameterEstimate | None
    fading_db: ParameterEstimate | None
    path_loss: dict[str, Any]  # the rays, as in the scenario
    aic: float  # Akaike's information criterion
    log_distance: Calibration

    @property
    def deviation_db(self) -> float:
        """Standard deviation of a single level about the computed one."""
        return math.hypot(*(each.value for each in (self.shadowing_db, self.fading_db) if each is not None))

    def table(self) -> dict[str, Any]:
        """The ``[radio]`` table of a scenario with this radio: see `Calibration.table`."""
        fading, mean_db = _fading(self.fading_db)
        offset_db = self.path_loss.get("offset_db", 0.0) + mean_db - self.offset_db.value
        path_loss = {**self.path_loss, "offset_db": round(offset_db, 3)}
        shadowing = _shadowing(self.shadowing_db, self.correlation_distance_m, self.log_distance.spacing_m)
        return {"path_loss": path_loss, **shadowing, **fading}

    def toml(self) -> str:
        """The table as TOML, with a comment on its validity."""
        import tomli_w

        used, rows, power_dbm = self.log_distance.used, self.log_distance.rows, self.log_distance.tx_power_dbm
        comment = f"# fitted to {used} of {rows} rows, for tx_power_dbm = {power_dbm:g} (set it in [radio.phy])\n"
        return comment + tomli_w.dumps({"radio": self.table()})

    def summary(self) -> str:
        """A line for each number, and how much either model leaves unexplained."""
        log_distance = self.log_distance
        deviation, share = f"{log_distance.deviation_db:.2f} dB", self.deviation_db / log_distance.deviation_db
        lines = [
            f"{log_distance.used} of {log_distance.rows} rows, {log_distance.lost} lost",
            _line("offset from the rays", "dB", self.offset_db),
            *_variation_lines(self.shadowing_db, self.correlation_distance_m, self.fading_db),
            f"unexplained: {self.deviation_db:.2f} dB by rays, {deviation} by log-distance: {share:.2f} of it",
            f"AIC: rays {self.aic:.1f}, log-distance {min(log_distance.aic.values()):.1f} (lower is better)",
        ]
        return "\n".join(lines)


def _shadowing(deviation: ParameterEstimate | None, reach: ParameterEstimate | None, spacing_m: float) -> dict[str, Any]:
    """The layer's table under its name; empty: there is no such layer."""
    if deviation is None:
        return {}
    distance_m = round(spacing_m / 3.0 if reach is None else reach.value, 4)
    sigma_db = round(deviation.value, 3)
    return {"shadowing": {"kind": "gudmundson", "sigma_db": sigma_db, "correlation_distance_m": distance_m}}


def _fading(deviation: ParameterEstimate | None) -> tuple[dict[str, Any], float]:
    """The layer's table under its name, empty without such a layer, and the mean of its gain in dB."""
    from scipy.special import digamma

    shape = None if deviation is None else _nakagami(deviation.value)
    if shape is None:
        return {}, 0.0
    return {"fading": {"kind": "nakagami", "m": round(shape, 4)}}, _DB * (float(digamma(shape)) - math.log(shape))


def _variation_lines(
    shadowing: ParameterEstimate | None, reach: ParameterEstimate | None, fading: ParameterEstimate | None
) -> list[str]:
    both = "shadowing" if fading is not None else "shadowing and fading"
    return [_line(both, "dB", shadowing), _line("correlation distance", "m", reach), _line("fading", "dB", fading)]


def _line(name: str, unit: str, estimate: ParameterEstimate | None) -> str:
    if estimate is None:
        return f"{name:<22}  none found"
    text = f"{name:<22} {estimate.value:8.2f} {unit:<3}  [{estimate.low:.2f}, {estimate.high:.2f}]"
    if not math.isfinite(estimate.standard_error):
        return f"{name:<22} {estimate.value:8.2f} {unit:<3}  (not determined by these rows)"
    text += f"  standard error {estimate.standard_error:.2f}"
    if estimate.naive_error is not None:
        text += f" ({estimate.naive_error:.2f} for independent rows)"
    return text


def _nakagami(deviation_db: float) -> float | None:
    """The shape m with this standard deviation in dB; None: the fading is negligible."""
    from scipy.optimize import brentq
    from scipy.special import polygamma

    least, most = _NAKAGAMI
    variance = (deviation_db / _DB) ** 2
    if variance <= float(polygamma(1, most)):
        return None
    if variance >= float(polygamma(1, least)):
        return least
    return brentq(lambda m: float(polygamma(1, m)) - variance, least, most)
