"""Keys and metrics in words, as they stand at an axis: with their units, which their names tell."""

import re

_UNITS = {  # by the ends of names, the longest first
    "m_s2": "m/s²", "rad_s2": "rad/s²", "m2_s": "m²/s", "m_s": "m/s", "rad_s": "rad/s", "1_s": "1/s", "s": "s", "m": "m",
    "hz": "Hz", "dbm": "dBm", "db": "dB", "rad": "rad", "deg": "degrees", "kg": "kg", "seconds": "s", "bytes": "bytes",
}  # fmt: skip
_STATISTIC = re.compile(r"mean|max|min|rms|p\d+|final|peak|time_average")
_WORDS = {"probability": "{table} probability", "seconds": "{table}", "count": "{table} count", "kind": "{table}"}
_METRICS = {
    "formation.rms_m": "formation error, RMS [m]",
    "formation.mean_m": "formation error, mean [m]",
    "formation.max_m": "formation error, greatest [m]",
    "formation.final_m": "formation error at the end [m]",
    "formation.settling_s": "settled after [s]",
    "radio.delivery_ratio": "share of frames delivered",
    "radio.age_s.mean": "age of information, mean [s]",
    "radio.age_s.p95": "age of information, 95th percentile [s]",
    "radio.age_s.max": "age of information, greatest [s]",
    "radio.delay_s.mean": "delay, mean [s]",
    "safety.min_separation_m": "smallest distance of two vehicles [m]",
    "safety.min_clearance_m": "smallest distance to an obstacle [m]",
}


def label_of(key: str) -> str:
    """A key or a metric in words, with its unit where the name tells one: ``radio.delay.jitter_s`` is ``jitter [s]``."""
    if key in _METRICS:
        return _METRICS[key]
    *above, last = key.split(".")
    stem, unit = _unit_of(last)
    words = _WORDS.get(stem, stem).format(table=above[-1] if above else "")
    of_what, its_unit = _unit_of(above[-1]) if above else ("", "")
    if above and (_STATISTIC.fullmatch(stem) or (its_unit and not unit)):
        words, unit = f"{of_what} {stem}", unit or its_unit
    elif above[:-1] == ["radio", "losses"] or above == ["radio", "losses"]:
        words = f"lost: {last}"
    return words.replace("_", " ") + (f" [{unit}]" if unit else "")


def _unit_of(name: str) -> tuple[str, str]:
    """A name without its unit, and the unit; empty where it tells none."""
    for end, unit in _UNITS.items():
        stem = name.removesuffix(f"_{end}")
        if stem not in (name, "") and not stem.isdigit():
            return stem, unit
    return name, _UNITS.get(name, "")
