"""A page is one well-formed file without external requests; its inputs appear as text."""

import re

import pytest

from tests.support.cosim.html_pages import Reader
from vcmvsp.cosim.report.page import Code, Facts, Figure, Part, Rows, Section, Words, cell, page

HOSTILE = "<script>alert(1)</script> & \"quoted\" 'too'"
DRAWING = """<?xml version="1.0"?>
<!DOCTYPE svg PUBLIC "-//W3C//DTD SVG 1.1//EN" "http://www.w3.org/Graphics/SVG/1.1/DTD/svg11.dtd">
<svg xmlns:xlink="http://www.w3.org/1999/xlink" width="72pt" height="36pt" viewBox="0 0 72 36" version="1.1">
 <metadata><a href="http://example.org">x</a></metadata>
 <defs><clipPath id="clip"><rect width="1" height="1"/></clipPath><path id="dot" d="M 0 0"/></defs>
 <g id="axes_1" clip-path="url(#clip)"><use xlink:href="#dot" width="3" height="4"/><text>loss</text></g>
</svg>
"""


def whole() -> str:
    parts: list[Part] = [
        Figure(DRAWING, f"one {HOSTILE}"),
        Figure(DRAWING, "two"),
        Rows(["key", HOSTILE], [[0.1, None], [HOSTILE, True]]),
        Facts([(HOSTILE, HOSTILE), ("seeds", "1 to 3")]),
        Code(HOSTILE),
        Code("name = 1", folded="the file"),
        Words(HOSTILE),
    ]
    return page(HOSTILE, HOSTILE, [Section(HOSTILE, parts)])


def test_every_tag_is_closed_where_it_should_be() -> None:
    assert page("title", "lead", []).startswith("<!DOCTYPE html>\n<html lang=")
    Reader(whole())


def test_nothing_is_fetched_from_anywhere() -> None:
    text = whole()
    resources = Reader(text).resources
    assert resources
    assert all(each.startswith("#") for each in resources)
    assert "@import" not in text
    assert "<link" not in text
    assert "<script" not in text


def test_inputs_are_text_and_never_markup() -> None:
    read = Reader(whole())
    assert read.words.count(HOSTILE) == 11  # title twice, lead, heading, caption, head and cell, fact and name, code, paragraph


def test_ids_of_two_drawings_do_not_collide_and_references_resolve() -> None:
    read = Reader(whole())
    assert len(read.ids) == len(set(read.ids)) == 7  # three per drawing, and the section's
    assert {each[1:] for each in read.resources} <= set(read.ids)


def test_only_the_outer_size_of_a_drawing_is_removed() -> None:
    text = whole()
    assert 'width="72pt"' not in text
    assert text.count('viewBox="0 0 72 36"') == 2
    assert text.count('width="3" height="4"') == 2
    assert "metadata" not in text


def test_it_has_dark_and_print_styles() -> None:
    text = whole()
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text
    assert re.search(r"figure \{[^}]*background: #ffffff", text)  # drawings have dark ink: they need a light card


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"),
        (True, "true"),
        (3, "3"),
        ("dr", "dr"),
        (0.0, "0"),
        (0.1, "0.1"),
        (0.0123456, "0.01235"),
        (-1234.56, "-1235"),
        (99999.0, "99999"),
        (1.0, "1"),
        (1.23456e-7, "1.235e-07"),
        (4.2e12, "4.200e+12"),
    ],
)
def test_numbers_in_tables_have_four_digits(value: object, shown: str) -> None:
    assert cell(value) == shown
