"""The standard atmosphere up to 11 km (ISO 2533:1975)."""


def pressure_hpa(height_m: float) -> float:
    """Pressure: 1013.25 (1 - 0.0065 h / 288.15)^5.25588."""
    return 1013.25 * (1.0 - 0.0065 * height_m / 288.15) ** 5.25588


def temperature_c(height_m: float) -> float:
    """Temperature."""
    return 15.0 - 0.0065 * height_m
