"""Files of a validation: head figures as Markdown, all rows as CSV and JSON. They contain no time stamps."""

import math
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vcmvsp.cosim.reproduction.row import COLUMNS, write_csv
from vcmvsp.cosim.reproduction.validation import CHECKS, Outcome
from vcmvsp.cosim.util.files import to_json, write_whole, writing
from vcmvsp.cosim.util.versions import version_of

SCHEMA = "vcmvsp.validation/1"
LIBRARIES = ("numpy", "scipy", "pybullet")
HEAD = """\
# Validation

<!-- written by vcmvsp validate -->

**{checks} of {all_checks} checks, {rows} rows, {verdict}.** Made with {made_with}.

Every number was measured by this command, in about {minutes:.0f} min of one core. The same versions give the
same numbers:

    vcmvsp validate{only}

The command also writes all rows, with their expected and measured numbers: `validation.csv` and
`validation.json`. The source of an expected number stands beside it in `cosim/reproduction`.

A row holds if |measured - expected| <= tolerance. The column *used* is the largest share of a tolerance that
a row of the check uses; 1 is the limit. A *reduced* check has fewer runs than `vcmvsp figure` of the same name.

| check | what | expected by | rows | used | off |
|---|---|---|--:|--:|--:|
"""


def write(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Write VALIDATION.md, validation.csv and validation.json; returns their paths."""
    head, table, everything = (folder / name for name in ("VALIDATION.md", "validation.csv", "validation.json"))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(head, as_markdown(outcomes))
        write_csv(table, ("check", *COLUMNS), ((each.check.name, *row.csv) for each in outcomes for row in each.rows))
        write_whole(everything, as_json(outcomes))
    return [head, table, everything]


def as_json(outcomes: Sequence[Outcome]) -> str:
    """All checks with their rows, by the schema ``vcmvsp.validation/1``."""
    checks: list[dict[str, Any]] = []
    for each in outcomes:
        about = {name: getattr(each.check, name) for name in ("name", "area", "title", "source", "reduced")}
        checks.append({**about, "ok": each.ok, "problem": each.problem, "rows": [row.plain for row in each.rows]})
    return to_json({"schema": SCHEMA, "made_with": _versions(), "ok": all(each.ok for each in outcomes), "checks": checks})


def as_markdown(outcomes: Sequence[Outcome]) -> str:
    """The head figures of all checks, one line each."""
    off = failures(outcomes)
    only = ""
    if len(outcomes) < len(CHECKS):
        only = "".join(f" --only {each.check.name}" for each in outcomes)
    rows = sum(len(each.rows) for each in outcomes)
    seconds = sum(each.check.seconds for each in outcomes)
    head = HEAD.format(
        checks=len(outcomes),
        all_checks=len(CHECKS),
        rows=rows,
        verdict=f"{len(off)} off" if off else "all hold",
        made_with=", ".join(_versions()),
        minutes=max(1.0, seconds / 60.0),
        only=only,
    )
    return head + "".join(map(head_line, outcomes))


def head_line(outcome: Outcome) -> str:
    """The line of a check in the table of VALIDATION.md."""
    check = outcome.check
    title = f"{check.title} Reduced: {check.reduced}." if check.reduced else check.title
    used = max((row.tolerance_used for row in outcome.rows), default=math.inf)
    off = f"**{len(outcome.missed)}**" if outcome.missed else "0"
    verdict = off if outcome.rows else "**broke off**"
    cells = [f"`{check.name}`", title, check.source, str(len(outcome.rows)), f"{used:.2g}", verdict]
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """A line for each row outside its tolerance and for each check that failed with an error."""
    lines = []
    for each in outcomes:
        for row in each.missed:
            case, expected, measured, tolerance = row.cells
            lines.append(f"{each.check.name}: {case}: {measured}, not {expected} within {tolerance}")
        if not each.rows:
            lines.append(f"{each.check.name}: {each.problem}")
    return lines


def _versions() -> list[str]:
    versions = [f"{name} {version_of(name)}" for name in ("vcmvsp", *LIBRARIES)]
    return [*versions, f"Python {platform.python_version()}", platform.machine()]
