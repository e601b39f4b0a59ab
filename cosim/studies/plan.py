"""Plan of a study: a scenario, values of its keys (``--vary``), seeds. Saved as ``study.toml`` before the first run."""

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.types import Seed
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml

EXAMPLE = "--vary radio.loss.probability=0,0.2,0.5 or --vary radio.loss.probability=0:0.9:0.1"
MOST = 1_000_000  # runs of a study
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(?::({_NUMBER}))?")
_PAIRS = {"[": "]", "{": "}"}


def vary_of(arguments: Sequence[str]) -> dict[str, list[Any]]:
    """Parse ``--vary`` arguments into key path -> values."""
    vary: dict[str, list[Any]] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        key = key.strip()
        if not equals or not key:
            raise UsageError(f"--vary {argument}: write KEY=VALUES, e.g. {EXAMPLE}")
        if key in vary:
            raise UsageError(f"--vary {argument}: {key} is already varied; give all its values in one option")
        try:
            vary[key] = values_of(text)
        except ValueError as error:
            raise UsageError(f"--vary {argument}: {error}") from error
    return vary


def values_of(text: str) -> list[Any]:
    """Parse ``a,b,c`` or ``start:stop:step`` (both ends included) into values, each in TOML.

    Commas inside quotes, lists and inline tables do not separate; text that is not TOML is a string, as in ``--set``.
    Ranges are computed in decimals: ``0:1:0.1`` has eleven values, and the fourth is 0.3.

    Raises:
        ValueError: the text is malformed; says how.
    """
    values: list[Any] = []
    for item in _items(text):
        if not item:
            raise ValueError('a value is missing (write "" for an empty string)')
        ends = _RANGE.fullmatch(item)
        values += _range(item, *ends.groups()) if ends else [loader.value_of(item)]
    return values


def label(value: object) -> str:
    """The value as text, equal for values that are equal in a scenario: 1 and 1.0, but not 1 and true."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return json.dumps(value, sort_keys=True, default=str)


def _items(text: str) -> list[str]:
    """Split a text at commas outside quotes and brackets."""
    items, closing, quote, escaped = [""], "", "", False
    for sign in text:
        if quote:
            quote = "" if sign == quote and not escaped else quote
            escaped = sign == "\\" and quote == '"' and not escaped
        elif sign in "\"'":
            quote = sign
        elif sign in _PAIRS:
            closing = _PAIRS[sign] + closing
        elif closing[:1] == sign:
            closing = closing[1:]
        elif sign == "," and not closing:
            items.append("")
            continue
        items[-1] += sign
    if quote or closing:
        raise ValueError(f"there is no closing {quote or closing[0]}")
    return [item.strip() for item in items]


def _range(item: str, *ends: str | None) -> list[int] | list[float]:
    if ends[2] is None:
        raise ValueError(f"{item} is neither a value nor start:stop:step")
    start, stop, step = (Decimal(end) for end in ends if end is not None)
    if not all(math.isfinite(float(end)) for end in (start, stop, step)):
        raise ValueError(f"{item}: must be finite")
    if not step or (stop - start) * step < 0:
        raise ValueError(f"{item}: this step does not lead from {start} to {stop}")
    if abs(stop - start) >= MOST * abs(step):
        raise ValueError(f"{item}: more than {MOST} values")
    steps = range(int((stop - start) / step) + 1)
    if all(end.lstrip("+-").isdigit() for end in ends if end is not None):
        return [int(start + i * step) for i in steps]
    return [float(start + i * step) for i in steps]


SCHEMA = "vcmvsp.study/1"
OWN_COLUMNS = ("seed", "error", "digest")


class Run(NamedTuple):
    """One run of a study."""

    point: tuple[Any, ...]  # a value for each varied key
    seed: int

    @property
    def key(self) -> str:
        """Identifier of the run, independent of the order of values, of process and of file."""
        return "\n".join((*map(label, self.point), str(self.seed)))


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """Plan of a study. All points have the same seeds and thus the same draws (common random numbers)."""

    scenario: str  # its name, or its file
    scenario_toml: str  # its text at the start of the study
    vary: dict[str, list[Any]]  # key path -> values; the study runs their product, the last key changes fastest
    seeds: list[int]
    metrics: list[str] = []  # metrics to draw and summarise
    set: dict[str, Any] = {}  # key path -> value, for all runs
    versions: dict[str, str] = {}
    files: dict[str, str] = {}  # SHA-256 of each file that a point uses, by name; several if its content differs between points
    schema: str = SCHEMA

    @property
    def points(self) -> Iterator[tuple[Any, ...]]:
        """All combinations of the values."""
        return itertools.product(*self.vary.values())

    @property
    def runs(self) -> Iterator[Run]:
        """All runs in the order of the table: point by point, seed by seed."""
        return (Run(point, seed) for point in self.points for seed in self.seeds)

    @property
    def size(self) -> int:
        """Number of runs."""
        return len(self.seeds) * math.prod(map(len, self.vary.values()))

    def settings(self, point: tuple[Any, ...]) -> dict[str, Any]:
        """Settings of a point, as for ``--set``."""
        return {**self.set, **dict(zip(self.vary, point, strict=True))}

    def to_toml(self) -> str:
        """Text of ``study.toml``: first seed and number of seeds, and the scenario's text, verbatim if TOML can hold it."""
        rest = {
            name: value for name, value in msgspec.to_builtins(self).items() if name not in ("scenario_toml", "seeds", "schema")
        }
        head = {"schema": self.schema, "seed": self.seeds[0], "seeds": len(self.seeds)}
        whole = f"scenario_toml = '''\n{self.scenario_toml}'''\n{tomli_w.dumps({**head, **rest})}"
        try:
            if read_toml(whole)["scenario_toml"] == self.scenario_toml:
                return whole
        except ValueError:  # three quotes inside
            pass
        return tomli_w.dumps({"scenario_toml": self.scenario_toml, **head, **rest})

    @classmethod
    def read(cls, path: Path) -> "Plan":
        """Read the plan from a ``study.toml``."""
        try:
            table = read_toml(limits.read_text(path))
            first = table.pop("seed")
            return msgspec.convert({**table, "seeds": list(range(first, first + table["seeds"]))}, cls)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{path} cannot be read: {' '.join(str(error).split())}") from error


class Base(NamedTuple):
    """The scenario of a study."""

    text: str  # TOML
    folder: Path  # base of its relative file names
    asked: str | Path | Mapping[str, Any]  # as the caller gave it, for messages with lines


def base_of(scenario: str | Path | Mapping[str, Any]) -> Base:
    """The scenario with its text read once, so that later changes of the file have no effect."""
    if isinstance(scenario, Mapping):
        return Base(tomli_w.dumps(binding.plain(dict(scenario))), Path.cwd(), scenario)
    return Base(loader.text_of(scenario), loader.path_of(scenario).resolve().parent, scenario)


def content(text: str) -> dict[str, Any]:
    """The scenario's content without ``[study]``."""
    return {name: value for name, value in read_toml(text).items() if name != "study"}


def make(
    base: Base,
    *,
    vary: Mapping[str, Any] | None,
    seeds: int | None,
    seed: int | None,
    settings: Mapping[str, Any],
    metrics: Sequence[str] | None,
    stored: Plan | None,
) -> Plan:
    """Make the plan of a study: arguments, else the ``stored`` plan, else ``[study]`` of the scenario.

    Raises:
        UsageError, ScenarioError: no key is varied, a value is repeated, or there are no seeds.
    """
    parsed, _ = loader.load(base.asked, settings=settings, seed=seed)
    table = parsed.study
    full = stored.vary if stored and not vary else _vary(vary or table.vary)
    if not full:
        raise UsageError(f"nothing is varied: the scenario has no [study] table; add e.g. {EXAMPLE}")
    for key, values in full.items():
        _check_values(key, values, settings)
    usual_count, usual_metrics = (len(stored.seeds), stored.metrics) if stored else (table.seeds, table.metrics)
    count = usual_count if seeds is None else seeds
    if count < 1:
        raise UsageError(f"--seeds {count}: must be at least 1")
    first = parsed.seed if seed is not None or not stored else stored.seeds[0]
    if count * math.prod(map(len, full.values())) > MOST:
        raise UsageError(f"more than {MOST} runs: use fewer values or --seeds")
    binding.convert(first + count - 1, Seed, key="--seed plus --seeds")
    name = parsed.name if isinstance(base.asked, Mapping) else str(base.asked)
    metrics = [metrics] if isinstance(metrics, str) else list(metrics or usual_metrics)
    return Plan(
        scenario=name,
        scenario_toml=base.text,
        vary=full,
        seeds=list(range(first, first + count)),
        metrics=metrics,
        set={key: binding.plain(value) for key, value in settings.items()},
    )


def check_same(plan: Plan, stored: Plan, out: Path) -> None:
    """Reject the continuation of a different study; values and seeds may have been added.

    Raises:
        UsageError: the studies differ; names the difference.
    """
    for subject, now, then in (
        ("the scenario", content(plan.scenario_toml), content(stored.scenario_toml)),
        ("--set", plan.set, stored.set),
        ("its file", *_in_both(plan.files, stored.files)),
        ("the version of", _ours(plan.versions), _ours(stored.versions)),
    ):
        if (difference := _difference(now, then)) is not None:
            raise UsageError(f"--resume {out}: holds another study: {subject} differs ({difference})")
    if list(plan.vary) != list(stored.vary):
        raise UsageError(f"--resume {out}: holds another study: it varies {', '.join(stored.vary)}, in this order")
    for key, values in stored.vary.items():
        present = {label(value) for value in plan.vary[key]}
        if omitted := [value for value in map(label, values) if value not in present]:
            raise UsageError(
                f"--resume {out}: values may be added, not left out: {key} was varied over {', '.join(omitted)} too"
            )
    if not {*stored.seeds} <= {*plan.seeds}:
        was = f"{stored.seeds[0]} to {stored.seeds[-1]}"
        raise UsageError(f"--resume {out}: seeds may be added, not left out: they were {was}")


def _vary(vary: Mapping[str, Any]) -> dict[str, list[Any]]:
    if not isinstance(vary, Mapping):
        raise UsageError(f"vary: must be a mapping, e.g. {{'radio.loss.probability': [0.0, 0.3]}}, not {binding.show(vary)}")
    full: dict[str, list[Any]] = {}
    for key, values in vary.items():
        try:
            full[key] = values_of(values) if isinstance(values, str) else list(map(_plain, values))
        except (TypeError, ValueError) as error:
            raise UsageError(f"the values of {key}: {error}") from error
    return full


def _plain(value: object) -> object:
    """Convert a Python or NumPy value to TOML types."""
    converted = binding.plain(value.tolist() if hasattr(value, "tolist") else value)
    if converted is None:
        raise ValueError(f"{binding.show(value)} is not a valid value of a scenario")
    return converted


def _check_values(key: str, values: Sequence[Any], settings: Mapping[str, Any]) -> None:
    if key in settings:
        raise UsageError(f"{key} is both set and varied; leave one of them out")
    if key in OWN_COLUMNS:
        raise UsageError(f"{key} cannot be varied; --seeds sets the number of seeds, --seed the first one")
    if not values:
        raise UsageError(f"{key} is varied without values; add at least one")
    labels: set[str] = set()
    for value in values:
        if (bad := binding.unfit_number(value)) is not None:
            raise UsageError(f"--vary {key}={binding.show(value)}: {binding.problem_of(bad)}")
        if label(value) in labels:
            raise UsageError(f"{key} is varied over {label(value)} twice")
        labels.add(label(value))


def _ours(versions: Mapping[str, str]) -> dict[str, str]:
    return {name: version for name, version in versions.items() if name == "vcmvsp"}


def _in_both(now: Mapping[str, str], then: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """The common files of both plans, now and then; files of added values are ignored."""
    names = [name for name in then if name in now]
    before = {name: then[name] for name in names}
    changed = {name: now[name] for name in names if not {*then[name].split()} <= {*now[name].split()}}
    return {**before, **changed}, before


def _difference(now: object, then: object, key: str = "") -> str | None:
    """The first difference of two nested values, or None."""
    if isinstance(now, dict) and isinstance(then, dict):
        names = [*then, *(name for name in now if name not in then)]
        inside = (_difference(now.get(name), then.get(name), binding.join(key, name)) for name in names)
        return next((each for each in inside if each is not None), None)
    if isinstance(now, list) and isinstance(then, list) and len(now) == len(then):
        pairs = enumerate(zip(now, then, strict=True))
        return next((each for i, (a, b) in pairs if (each := _difference(a, b, f"{key}[{i}]")) is not None), None)
    if now == then:
        return None
    return f"{key}: {_shown(now)} now, {_shown(then)} then"


def _shown(value: object) -> str:
    return "nothing" if value is None else binding.show(value)
