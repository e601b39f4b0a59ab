"""Outputs of a study: summary table, figures, and a report with both and the data to repeat the study."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from vcmvsp.cosim.report.page import Code, Facts, Figure, Part, Rows, Section, Words, cell, counted, page
from vcmvsp.cosim.report.run_page import FILE
from vcmvsp.cosim.runs.figures import are_enabled
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.studies.plan import Plan
from vcmvsp.cosim.studies.store import PLAN, so_far
from vcmvsp.cosim.studies.summary import summarise, to_csv
from vcmvsp.cosim.util.documents import toml_line
from vcmvsp.cosim.util.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure as FigureOfPlots

LISTED_FAILURES = 100


def write(folder: Path, table: pa.Table, plan: Plan, *, repeatable: bool = True) -> list[Path]:
    """Write ``summary.csv``, ``study.png``, ``study-map.png``, both as ``.svg`` and ``.pdf`` too, and ``report.html``.

    ``VCMVSP_FIGURES=0`` in the environment leaves the figures out.

    Args:
        table: a row for each run: the varied keys, ``seed``, metrics, ``error`` and ``digest``.
        plan: of the study. The map is drawn if two numeric keys were varied.
        repeatable: whether the scenario has a name or a file, so that a command can repeat the study.

    Returns:
        The files.
    """
    summary = summarise(table, list(plan.vary), plan.metrics)
    written = [folder / "summary.csv"]
    write_whole(written[0], to_csv(summary))
    paths = _drawn(folder, summary, plan) if are_enabled() else []
    drawings = {path.stem: path.read_text("utf-8") for path in paths if path.suffix == ".svg"}
    report = folder / FILE
    write_whole(report, _page(table, summary, plan, drawings, repeatable=repeatable))
    return [*written, *paths, report]


def report_again(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a study again from its folder, also of an unfinished study.

    Raises:
        UsageError: its plan or rows cannot be read.
    """
    from vcmvsp.cosim.plots import style

    plan = Plan.read(folder / PLAN)
    table = so_far(folder, plan)
    summary = summarise(table, list(plan.vary), plan.metrics)
    drawings = {name: style.svg(figure) for name, figure in _figures(summary, plan).items()}
    path = out or folder / FILE
    write_whole(path, _page(table, summary, plan, drawings, repeatable=_is_file(plan)))
    return path


def _drawn(folder: Path, summary: pa.Table, plan: Plan) -> list[Path]:
    from vcmvsp.cosim.plots import style

    return [path for name, figure in _figures(summary, plan).items() for path in style.save(figure, folder / name)]


def _figures(summary: pa.Table, plan: Plan) -> "dict[str, FigureOfPlots]":
    from vcmvsp.cosim.plots import study_plot

    keys, metrics = list(plan.vary), list(plan.metrics)
    if not metrics or not summary.num_rows:
        return {}
    title = Path(plan.scenario).stem
    many = len(plan.seeds) > 1
    means = f"{title}: means of {len(plan.seeds)} runs" if many else title
    figures = {"study": study_plot.lines(summary, keys, metrics, f"{means} with 95 % bands" if many else title)}
    if (over_two := study_plot.heat_map(summary, keys, metrics[0], means)) is not None:
        figures["study-map"] = over_two
    return figures


def _is_file(plan: Plan) -> bool:
    """Whether the scenario was given by name or file, not as a mapping."""
    if Path(plan.scenario).suffix == ".toml":
        return True
    return plan.scenario in loader.names() and loader.text_of(plan.scenario) == plan.scenario_toml


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


def toml_of(value: object) -> str:
    """A value as ``--set`` and ``--vary`` read it."""
    if isinstance(value, str) and value.replace("_", "").replace("-", "").isalnum() and loader.value_of(value) == value:
        return value
    return toml_line(value)


def _page(table: pa.Table, summary: pa.Table, plan: Plan, drawings: Mapping[str, str], *, repeatable: bool) -> str:
    failures = _failures(table, list(plan.vary))
    captions = {"study": "Means at each point, and where they may lie.", "study-map": "Means over the first two keys."}
    sections = [
        Section("What was varied", [Facts(_varied(plan))]),
        Section("Figures", [Figure(svg, captions[name]) for name, svg in drawings.items()]),
    ]
    if summary.num_rows:
        sections.append(Section("Summary", [Words(_EXPLAINED), _table(summary, plan)]))
    if failures:
        sections.append(_failed(failures, list(plan.vary)))
    if repeatable:
        sections.append(Section("Again", _again(plan, unfinished=bool(failures) or table.num_rows < plan.size)))
    sections.append(Section("Scenario", [Code(plan.scenario_toml, folded="its file, without what was varied or set")]))
    sections.append(Section("Versions", [Facts(list(plan.versions.items()))]))
    lead = " ".join(_lead(table, summary, plan, len(failures)))
    return page(f"Study of {plan.scenario}", lead, [each for each in sections if each.parts])


def _lead(table: pa.Table, summary: pa.Table, plan: Plan, failed: int) -> Iterator[str]:
    """Lines on the runs and the range of each metric's means."""
    points, seeds = plan.size // len(plan.seeds), len(plan.seeds)
    failures = f"; {failed} failed" if failed else ""
    yield f"{counted(plan.size, 'run')}: {counted(points, 'point')} with {counted(seeds, 'seed')} each{failures}."
    if table.num_rows < plan.size:
        yield f"Of these only {table.num_rows} are done yet: the study was cut, or goes on."
    columns = summary.to_pydict()
    for metric in plan.metrics:
        means = [(mean, row) for row, mean in enumerate(columns[f"{metric}.mean"]) if mean is not None]
        if len(means) < 2:
            continue
        (low, at_low), (high, at_high) = min(means), max(means)
        if low == high:
            yield f"{metric} is {cell(low)} everywhere."
        else:
            lowest, highest = _point(columns, plan, at_low), _point(columns, plan, at_high)
            yield f"{metric} is {cell(low)} on average at {lowest}, and {cell(high)} at {highest}."


def _point(columns: Mapping[str, list[Any]], plan: Plan, row: int) -> str:
    return ", ".join(f"{key} {cell(columns[key][row])}" for key in plan.vary)


def _again(plan: Plan, *, unfinished: bool) -> list[Part]:
    command = command_of(plan)
    parts: list[Part] = [Code(command)]
    if unfinished:
        parts += [Words("The rest, and what failed; --out names the folder of this study:"), Code(f"{command} --resume")]
    else:
        parts.append(Words("With --resume, and more --seeds or more values, it goes on where it ended."))
    return parts


_EXPLAINED = (
    "Each point's mean over its seeds, and the 95 % band of that mean (bootstrap, 9999 resamples). "
    "n counts the runs that succeeded; where a metric has no value in some of them, its own n says in how many it has."
)


def _varied(plan: Plan) -> list[tuple[str, str]]:
    facts = [(key, ", ".join(map(toml_of, values))) for key, values in plan.vary.items()]
    first, last = plan.seeds[0], plan.seeds[-1]
    facts.append(("seeds", str(first) if first == last else f"{first} to {last}"))
    return [*facts, *((f"{key} (all runs)", toml_of(value)) for key, value in plan.set.items())]


def _table(summary: pa.Table, plan: Plan) -> Rows:
    """The summary with a column for each bound of a band, which is easier to compare than ``low to high``."""
    keys = list(plan.vary)
    columns = summary.to_pydict()
    partly = [metric for metric in plan.metrics if columns[f"{metric}.n"] != columns["n"]]
    headings: list[tuple[str, str]] = [*((key, key) for key in keys), ("n", "n")]
    if any(columns["failed"]):
        headings.append(("failed", "failed"))
    for metric in plan.metrics:
        headings += [(f"{metric}.mean", metric), (f"{metric}.low", "low"), (f"{metric}.high", "high")]
        headings += [(f"{metric}.n", "its n")] if metric in partly else []
    names, titles = zip(*headings, strict=True)
    rows = _plain_rows([columns[name] for name in names])
    return Rows(titles, rows)


def _failures(table: pa.Table, keys: Sequence[str]) -> list[list[Any]]:
    failed = table.filter(pc.is_valid(table.column("error")))
    return _plain_rows([failed.column(name).to_pylist() for name in (*keys, "seed", "error")])


def _failed(failures: list[list[Any]], keys: Sequence[str]) -> Section:
    parts: list[Part] = [Rows([*keys, "seed", "error"], failures[:LISTED_FAILURES])]
    if len(failures) > LISTED_FAILURES:
        parts.append(Words(f"And {len(failures) - LISTED_FAILURES} more: see study.parquet, column error."))
    return Section("Failed runs", parts)


def _plain_rows(columns: Sequence[Sequence[Any]]) -> list[list[Any]]:
    return [list(map(_plain, row)) for row in zip(*columns, strict=True)]


def _plain(value: object) -> object:
    return toml_of(value) if isinstance(value, list | Mapping) else value
