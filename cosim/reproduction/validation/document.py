"""What a validation leaves: a document that can be read, and the same as JSON. Nothing in them tells when they were made."""

import platform
from collections.abc import Iterator, Sequence
from importlib import metadata
from itertools import groupby
from pathlib import Path

from vcmvsp.cosim.reproduction.validation import CHECKS
from vcmvsp.cosim.reproduction.validation.check import Outcome
from vcmvsp.cosim.util.files import to_json, write_whole, writing

SCHEMA = "vcmvsp.validation/1"
LIBRARIES = ("numpy", "scipy", "pybullet")


def write(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Write VALIDATION.md and validation.json; the answer is where they are."""
    paths = [folder / "VALIDATION.md", folder / "validation.json"]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in zip(paths, (as_markdown(outcomes), as_json(outcomes)), strict=True):
            write_whole(path, content)
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
            "rows": [row.plain for row in each.rows],
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
        for row in each.missed:
            case, expected, measured, tolerance = row.cells
            lines.append(f"{each.check.name}: {case}: {measured}, not {expected} within {tolerance}")
        if not each.rows:
            lines.append(f"{each.check.name}: {each.problem}")
    return lines


def _summary(outcomes: Sequence[Outcome]) -> Iterator[str]:
    rows, off = sum(len(each.rows) for each in outcomes), failures(outcomes)
    yield "# Validation\n"
    yield (
        "What the platform does, beside what is known without it: closed forms, standards, figures of the literature, other\n"
        "programs. `vcmvsp validate` has measured every number under *measured* anew, and written this document.\n"
    )
    verdict = f"{len(off)} off" if off else "all hold"
    yield f"**{len(outcomes)} of {len(CHECKS)} checks, {rows} rows, {verdict}.** Made with {', '.join(_made_with())}.\n"
    only = "" if len(outcomes) == len(CHECKS) else "".join(f" --only {each.check.name}" for each in outcomes)
    minutes = sum(each.check.seconds for each in outcomes) / 60.0
    yield f"To make it again, in about {max(minutes, 1.0):.0f} min of one core; the same versions give the same numbers:\n"
    yield f"    vcmvsp validate{only}\n"
    yield (
        "A row holds where measured and expected differ by no more than the tolerance, an absolute number; where it is a\n"
        "share of what is expected, the case says so. Where another program, a standard or a book says what is to be\n"
        "expected, that stands under *expected by*, and in the code beside the number (`cosim/reproduction`).\n"
        "A check that is *reduced* has fewer runs than `vcmvsp figure` of the same name; its tolerances are the same.\n"
    )
    yield "| area | check | what | expected by | rows | off |"
    yield "|---|---|---|---|--:|--:|"
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
            if each.problem:
                yield f"\n{each.problem}"
            else:
                yield "\n| case | expected | measured | tolerance | verdict |\n|---|--:|--:|--:|---|"
            for row in each.rows:
                yield _line(*row.cells, "holds" if row.ok else "**OFF**")


def _line(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _made_with() -> list[str]:
    versions = [f"{name} {metadata.version(name)}" for name in ("vcmvsp", *LIBRARIES)]
    return [*versions, f"Python {platform.python_version()}", platform.machine()]
