"""Self-contained HTML page: a title, a lead, and sections of figures, tables and text. It makes no network requests.

The template escapes all content except figures, which must be SVG drawn by this program. The page forbids scripts and external
resources, and allows only its own style sheets and those of its figures.
"""

import base64
import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

HERE = Path(__file__).resolve().parent
STYLE = re.compile("<style[^>]*>(.*?)</style>", re.DOTALL)


@dataclass(frozen=True)
class Figure:
    """A drawing, as the text of an SVG file."""

    svg: str
    words: str  # alternative text
    kind: str = "figure"


@dataclass(frozen=True)
class Rows:
    """A table; numbers are shown with four digits, None as a dash."""

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    kind: str = "rows"

    @property
    def numeric(self) -> frozenset[int]:
        """The columns that contain numbers."""
        return frozenset(place for row in self.rows for place, value in enumerate(row) if _is_number(value))


@dataclass(frozen=True)
class Facts:
    """Pairs of name and value."""

    facts: Sequence[tuple[str, Any]]
    kind: str = "facts"


@dataclass(frozen=True)
class Code:
    """Literal text: a command, a file. With ``folded``, these words stand for it until the reader opens it."""

    text: str
    folded: str = ""
    kind: str = "code"


@dataclass(frozen=True)
class Words:
    """A paragraph."""

    text: str
    kind: str = "words"


Part = Figure | Rows | Facts | Code | Words


@dataclass(frozen=True)
class Section:
    """A heading and its content."""

    title: str
    parts: Sequence[Part]


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """The page as HTML."""
    figures = [part for section in sections for part in section.parts if isinstance(part, Figure)]
    style = (HERE / "style.css").read_text("utf-8")
    return _template().render(
        title=title,
        lead=lead,
        sections=sections,
        style=Markup(style),  # noqa: S704  our own file
        policy=_policy([style, *(each for figure in figures for each in STYLE.findall(figure.svg))]),
        inline=lambda figure: _inline(figure, figures.index(figure)),
    )


def _policy(styles: Sequence[str]) -> Markup:
    digests = (hashlib.sha256(each.encode()).digest() for each in styles)
    hashes = sorted({f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests})
    rules = f"default-src 'none'; style-src-elem {' '.join(hashes)}; style-src-attr 'unsafe-inline'; img-src data:"
    return Markup(f"{rules}; base-uri 'none'; form-action 'none'")  # noqa: S704  nothing of it comes from elsewhere


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = cell
    environment.filters["breakable"] = _breakable
    environment.tests["number"] = _is_number
    return environment.get_template("page.html.jinja")


def cell(value: object) -> str:
    """A value formatted for a table cell."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return _digits(value)
    return str(value)


def counted(number: int, noun: str) -> str:
    """A number with its noun, in the plural unless it is 1."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _digits(value: float) -> str:
    """Four significant digits, without an exponent where that is readable."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if 1e-4 <= abs(value) < 1e6:
        places = max(0, 3 - math.floor(math.log10(abs(value))))
        text = f"{value:.{places}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.3e}"


def _breakable(name: str) -> Markup:
    return Markup(re.sub(r"(?<=[a-z0-9])([_.])(?=[a-z0-9])", r"\1<wbr>", str(Markup.escape(name))))  # noqa: S704  escaped


def _inline(figure: Figure, number: int) -> Markup:
    """An SVG file as an element of a page, with identifiers that are unique in the page."""
    svg = figure.svg[figure.svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r"""(\bid="|url\(#|href="#)""", rf"\g<1>f{number}-", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*" height="([^"]*)"', r"\1", svg, count=1)
    words = Markup.escape(figure.words)
    return Markup(svg.replace("<svg", f'<svg role="img" aria-label="{words}"', 1))  # noqa: S704  drawn by us
