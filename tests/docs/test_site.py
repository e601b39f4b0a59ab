"""The site has every page once, and loads nothing from other machines."""

import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.docs.readme_pages import PAGES
from tests.support.paths import ROOT

CONFIG = ROOT / "zensical.toml"
ELSEWHERE = {"LICENSE", "CITATION.cff"}


def pages(nav: list[dict[str, Any]]) -> Iterator[str]:
    for entry in nav:
        for target in entry.values():
            if isinstance(target, str):
                yield target
            else:
                yield from pages(target)


def test_every_page_is_in_the_navigation_once() -> None:
    shown = [*pages(tomllib.loads(CONFIG.read_text("utf-8"))["project"]["nav"])]
    assert len(shown) == len(set(shown))
    assert {*shown} >= {*PAGES}
    assert [each for each in shown if not (ROOT / each).is_file()] == []


@pytest.mark.slow
@pytest.mark.processes
def test_it_is_built_without_warnings_or_external_resources(tmp_path: Path) -> None:
    for page in (
        *PAGES,
        "CHANGELOG.md",
        "SECURITY.md",
        "VALIDATION.md",
        "bench/README.md",
        "cosim/DESIGN.md",
        "cosim/SCALING.md",
    ):
        target = tmp_path / ".site" / page
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / page, target)
        for picture in re.findall(r"\]\((?!http)([^)#\s]+\.(?:png|ipynb|py|cff))\)", (ROOT / page).read_text("utf-8")):
            copy = (target.parent / picture).resolve()
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy((ROOT / page).parent / picture, copy)
    shutil.copy(CONFIG, tmp_path)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    written = [path.read_text("utf-8") for path in (tmp_path / "site").rglob("*.html")]
    assert len(written) > len(PAGES)
    for text in written:
        assert not re.findall(r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="(?:https?:)?//[^"]+', text)
        assert 'class="mermaid"' not in text  # its script would be loaded from another machine
