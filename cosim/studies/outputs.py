"""What a study leaves to look at: its summary as a table, figures, and a page with both and all that is needed to repeat it."""

import shlex
from collections.abc import Mapping, Sequence
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

import pyarrow as pa
import tomli_w

from cosim import scenario as scenarios
from cosim.report.page import Code, Facts, Figure, Rows, Section, Words, page
from cosim.studies.plan import Plan
from cosim.studies.summary import summarise, to_csv

LISTED_FAILURES = 100


def write(folder: Path, table: pa.Table, plan: Plan, *, repeatable: bool = True) -> list[Path]:
    """Write ``summary.csv``, ``study.png``, ``study-map.png``, both as ``.svg`` too, and ``report.html``.

    Args:
        folder: which must exist.
        table: a row for each run: the varied keys, ``seed``, metrics, ``error`` and ``digest``.
        plan: what was studied. The map is drawn where two keys with numbers were varied.
        repeatable: whether the scenario has a name or a file, so that there is a command for it.

    Returns:
        What was written.
    """
    from cosim.record import plots, study_plot

    keys, metrics = list(plan.vary), list(plan.metrics)
    summary = summarise(table, keys, metrics)
    written = [folder / "summary.csv"]
    written[0].write_text(to_csv(summary), "utf-8")
    drawn: list[Path] = []
    if metrics:
        title = Path(plan.scenario).stem
        many = len(plan.seeds) > 1
        means = f"{title}: means of {len(plan.seeds)} runs" if many else title
        drawn += plots.save(
            study_plot.lines(summary, keys, metrics, f"{means} with 95 % bands" if many else title), folder / "study"
        )
        if (over_two := study_plot.heat_map(summary, keys, metrics[0], means)) is not None:
            drawn += plots.save(over_two, folder / "study-map")
    report = folder / "report.html"
    drawings = [path for path in drawn if path.suffix == ".svg"]
    report.write_text(_page(table, summary, plan, drawings, repeatable=repeatable), "utf-8")
    return [*written, *drawn, report]


def command_of(plan: Plan) -> str:
    """The command that repeats a study."""
    words = ["vcmvsp", "study", plan.scenario]
    for key, values in plan.vary.items():
        words += ["--vary", f"{key}={','.join(toml_of(value) for value in values)}"]
    words += ["--seeds", str(len(plan.seeds)), "--seed", str(plan.seeds[0])]
    for metric in plan.metrics:
        words += ["--metric", metric]
    for key, value in plan.set.items():
        words += ["--set", f"{key}={toml_of(value)}"]
    return shlex.join([*words, "--out", f"{Path(plan.scenario).stem}-study"])


def toml_of(value: Any) -> str:
    """A value as ``--set`` and ``--vary`` read it."""
    if isinstance(value, str):
        plain = value.replace("_", "").replace("-", "").isalnum() and scenarios.value_of(value) == value
        return value if plain else _quoted(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_quoted(str(key))} = {_inside(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inside(each) for each in value) + "]"
    if isinstance(value, bool | int | float | date | datetime | time):
        return tomli_w.dumps({"value": value}).removeprefix("value = ").strip()
    return str(value)


def _inside(value: Any) -> str:
    return _quoted(value) if isinstance(value, str) else toml_of(value)


def _quoted(text: str) -> str:
    return tomli_w.dumps({"value": text}).removeprefix("value = ").strip()


def _page(table: pa.Table, summary: pa.Table, plan: Plan, drawings: Sequence[Path], *, repeatable: bool) -> str:
    failures = _failures(table, list(plan.vary))
    points, seeds = summary.num_rows, len(plan.seeds)
    lead = f"{_count(table.num_rows, 'run')}: {_count(points, 'point')} with {_count(seeds, 'seed')} each"
    sections = [
        Section("What was varied", [Facts(_varied(plan))]),
        Section("Figures", [Figure(path.read_text("utf-8"), f"{path.stem} of {plan.scenario}") for path in drawings]),
        Section("Summary", [Words(_EXPLAINED), _table(summary, plan)]),
        _failed(failures, list(plan.vary)) if failures else None,
        Section("Again", [Code(command_of(plan))]) if repeatable else None,
        Section("Scenario", [Code(plan.scenario_toml, folded="its file, without what was varied or set")]),
        Section("Versions", [Facts(list(plan.versions.items()))]),
    ]
    lead += f"; {len(failures)} failed" if failures else ""
    return page(f"Study of {plan.scenario}", lead, [each for each in sections if each is not None and each.parts])


_EXPLAINED = (
    "Each point's mean over its seeds, and the 95 % band of that mean (bootstrap, 9999 resamples). "
    "n counts the runs that succeeded; where a metric has no value in some of them, its own n says in how many it has."
)


def _varied(plan: Plan) -> list[tuple[str, str]]:
    facts = [(key, ", ".join(toml_of(value) for value in values)) for key, values in plan.vary.items()]
    first, last = plan.seeds[0], plan.seeds[-1]
    facts.append(("seeds", str(first) if first == last else f"{first} to {last}"))
    return [*facts, *((f"{key} (all runs)", toml_of(value)) for key, value in plan.set.items())]


def _table(summary: pa.Table, plan: Plan) -> Rows:
    """The summary with bands as ``low to high`` would be hard to compare: a column each."""
    keys = list(plan.vary)
    columns = summary.to_pydict()
    partly = [metric for metric in plan.metrics if columns[f"{metric}.n"] != columns["n"]]
    shown: list[tuple[str, str]] = [*((key, key) for key in keys), ("n", "n")]
    if any(columns["failed"]):
        shown.append(("failed", "failed"))
    for metric in plan.metrics:
        shown += [(f"{metric}.mean", metric), (f"{metric}.low", "low"), (f"{metric}.high", "high")]
        shown += [(f"{metric}.n", "its n")] if metric in partly else []
    rows = [[_plain(columns[name][row]) for name, _ in shown] for row in range(summary.num_rows)]
    return Rows([title for _, title in shown], rows)


def _failures(table: pa.Table, keys: Sequence[str]) -> list[list[Any]]:
    columns = {name: table.column(name).to_pylist() for name in (*keys, "seed", "error")}
    return [[_plain(columns[name][row]) for name in columns] for row, error in enumerate(columns["error"]) if error is not None]


def _failed(failures: list[list[Any]], keys: Sequence[str]) -> Section:
    parts: list[Any] = [Rows([*keys, "seed", "error"], failures[:LISTED_FAILURES])]
    if len(failures) > LISTED_FAILURES:
        parts.append(Words(f"And {len(failures) - LISTED_FAILURES} more: see study.parquet, column error."))
    return Section("Failed runs", parts)


def _plain(value: Any) -> Any:
    return toml_of(value) if isinstance(value, list | Mapping) else value


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
