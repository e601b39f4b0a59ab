"""Display in Jupyter: tables and figures of results, and a bar while a run goes on. Elsewhere there is no bar."""

import html
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

EVERY_S = 0.25  # between two updates of a bar


class Figures(dict[str, Any]):
    """Figures of Matplotlib by name, which Jupyter shows as drawings."""

    def _repr_html_(self) -> str:
        return pictures(self)


def pictures(figures: Mapping[str, Any]) -> str:
    """HTML of figures, as drawings."""
    from vcmvsp.cosim.plots.style import svg

    drawings = (svg(figure).partition("<svg") for figure in figures.values())  # without the heading of a file
    return "".join(f"<div>{begin}{rest}</div>" for _, begin, rest in drawings)


def table(rows: Iterable[tuple[str, str]]) -> str:
    """HTML of a table of names and values."""
    cells = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def bar(title: str) -> Callable[[int, int], None] | None:
    """A function that shows (done, total) as a bar; None outside Jupyter."""
    ipython: Any = sys.modules.get("IPython")  # Jupyter has imported it
    if ipython is None or not hasattr(ipython.get_ipython(), "kernel"):
        return None
    display: Any = sys.modules["IPython.display"]
    handle, last_s = display.display(display.HTML(""), display_id=True), 0.0

    def show(done: int, total: int) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if now_s - last_s >= EVERY_S or done >= total:
            last_s = now_s
            words = f"{html.escape(title)} <progress value={done} max={total}></progress> {100 * done / max(total, 1):.0f} %"
            handle.update(display.HTML("" if done >= total else words))

    return show
