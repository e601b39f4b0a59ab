"""Pages in a browser: without errors, in light and dark, and in print."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim import view_pages
from tests.support.cosim.studies import LOSS, two

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures")]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with view_pages.browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, figures: None) -> dict[str, Path]:
    """Pages of a run and of a study."""
    folder = tmp_path_factory.mktemp("pages")
    vcmvsp.run(two(duration_s=2.0), out=folder / "run")
    vcmvsp.study(two(), vary={LOSS: [0.0, 0.5]}, seeds=2, metrics=["formation.rms_m"], jobs=1, out=folder / "study")
    return {name: folder / name / "report.html" for name in ("run", "study")}


@pytest.mark.parametrize("name", ["run", "study"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_opens_without_errors_and_further_requests(name: str, scheme: str, browser: Any, pages: dict[str, Path]) -> None:
    page = browser.new_page(color_scheme=scheme)
    events: list[str] = []
    page.on("console", lambda message: events.append(message.text))
    page.on("pageerror", lambda error: events.append(str(error)))
    page.on("request", lambda request: events.append(request.url))
    url = pages[name].as_uri()
    page.goto(url)
    assert events == [url]
    paper, ink = (page.evaluate(f"getComputedStyle(document.body).{each}") for each in ("backgroundColor", "color"))
    assert (_brightness(paper) > _brightness(ink)) == (scheme == "light")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")  # no horizontal overflow
    drawn = page.evaluate("[...document.querySelectorAll('figure svg')].map(each => each.getBoundingClientRect().height)")
    assert len(drawn) == (2 if name == "run" else 1)
    assert min(drawn) > 100
    page.close()


@pytest.mark.parametrize("name", ["run", "study"])
@pytest.mark.parametrize("smuggled", ["<script>canary = 1</script>", "<img src='data:,' onerror='canary = 1'>"])
def test_no_script_runs_on_it(name: str, smuggled: str, browser: Any, pages: dict[str, Path], tmp_path: Path) -> None:
    text = pages[name].read_text("utf-8")
    assert "unsafe-inline" not in re.sub("style-src-attr 'unsafe-inline'", "", text)
    (tmp_path / "page.html").write_text(text.replace("</main>", f"{smuggled}</main>"), "utf-8")
    page = browser.new_page()
    with page.expect_console_message(lambda message: "Content Security Policy" in message.text):
        page.goto((tmp_path / "page.html").as_uri())
    assert page.evaluate("window.canary") is None
    page.close()


@pytest.mark.parametrize("name", ["run", "study"])
def test_it_is_printed_on_a_few_pages(name: str, browser: Any, pages: dict[str, Path], tmp_path: Path) -> None:
    page = browser.new_page()
    page.goto(pages[name].as_uri())
    printed = page.pdf(path=str(tmp_path / "page.pdf"), format="A4")
    assert 1 <= printed.count(b"/Type /Page\n") <= 8
    page.close()


def _brightness(color: str) -> float:
    return sum(float(each) for each in color.removeprefix("rgb(").rstrip(")").split(","))
