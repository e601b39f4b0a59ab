"""What a validation leaves: a document that can be read, and the same as JSON. Nothing in them tells when they were made."""

import math
import platform
from collections.abc import Iterator, Sequence
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

from cosim.figures.kit import Row
from cosim.files import to_json, writing
from cosim.validation import CHECKS
from cosim.validation.kit import Outcome

SCHEMA = "vcmvsp.validation/1"
COLUMNS = "| case | expected | measured | tolerance | |"
LIBRARIES = ("numpy", "scipy", "pybullet")


def write(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Write VALIDATION.md and validation.json; the answer is where they are."""
    paths = [folder / "VALIDATION.md", folder / "validation.json"]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in zip(paths, (as_markdown(outcomes), as_json(outcomes)), strict=True):
            path.write_text(content, "utf-8")
    return paths


def as_json(outcomes: Sequence[Outcome]) -> str:
    """Checks with their rows (schema ``vcmvsp.validation/1``)."""
    checks = [
        {
            "name": each.check.name,
            "area": each.check.area,
            "title": each.check.title,
            "source": each.check.source,
            "reduced": each.check.reduced,
            "ok": each.ok,
            "problem": each.problem,
            "rows": [_plain(row) for row in each.rows],
        }
        for each in outcomes
    ]
    return to_json({"schema": SCHEMA, "made_with": _made_with(), "ok": all(each.ok for each in outcomes), "checks": checks})


def as_markdown(outcomes: Sequence[Outcome]) -> str:
    """The document: a table of all checks, and a table of the rows of each."""
    return "\n".join([*_summary(outcomes), *_details(outcomes)]) + "\n"


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """A line for each row that is off, and for each check that broke off."""
    lines = []
    for each in outcomes:
        lines += [
            f"{each.check.name}: {row.case}: {_short(row.measured)}, not {_short(row.expected)} within {_short(row.tolerance)}"
            for row in each.missed
        ]
        if not each.rows:
            lines.append(f"{each.check.name}: {each.problem}")
    return lines


def _summary(outcomes: Sequence[Outcome]) -> Iterator[str]:
    rows, off = sum(len(each.rows) for each in outcomes), failures(outcomes)
    yield "# Validation\n"
    yield (
        "Laws, closed forms, figures of the literature and outside references; `vcmvsp validate --out .` has measured all of\n"
        "it and written this document. A row holds where measured and expected differ by no more than the absolute tolerance.\n"
    )
    verdict = f"{len(off)} off" if off else "all hold"
    yield f"{len(outcomes)} of {len(CHECKS)} checks, {rows} rows, {verdict}. {', '.join(_made_with())}.\n"
    yield "| area | check | what | expected by | rows | off |"
    yield "|---|---|---|---|---|---|"
    for each in outcomes:
        off_here = str(len(each.missed)) if each.rows else "broke off"
        yield _line(each.check.area, f"`{each.check.name}`", each.check.title, each.check.source, str(len(each.rows)), off_here)


def _details(outcomes: Sequence[Outcome]) -> Iterator[str]:
    for area, checks in groupby(outcomes, key=lambda each: each.check.area):
        yield f"\n## {area}"
        for each in checks:
            yield f"\n### {each.check.name}\n"
            yield f"{each.check.title} Expected by: {each.check.source}."
            if each.check.reduced:
                yield f"Reduced: {each.check.reduced}."
            yield (
                f"\n{each.problem}" if each.problem else "\n| case | expected | measured | tolerance | |\n|---|---|---|---|---|"
            )
            for row in each.rows:
                numbers = map(_short, (row.expected, row.measured, row.tolerance))
                yield _line(row.case, *numbers, "holds" if row.ok else "**OFF**")


def _line(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _made_with() -> list[str]:
    versions = [f"{name} {metadata.version(name)}" for name in ("vcmvsp", *LIBRARIES)]
    return [*versions, f"Python {platform.python_version()}", platform.machine()]


def _short(value: float) -> str:
    return f"{value:.6g}"


def _plain(row: Row) -> dict[str, Any]:
    measured = row.measured if math.isfinite(row.measured) else None
    return {"case": row.case, "expected": row.expected, "measured": measured, "tolerance": row.tolerance, "ok": row.ok}
