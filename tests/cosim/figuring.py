"""A figure by its name, with all that holds for each of them, whatever comes out."""

import csv
import json
from pathlib import Path
from typing import Any

from cosim import figures
from cosim.figures.files import write
from cosim.figures.kit import Figure, Runner


def drawn(name: str, folder: Path, panels: int, **settings: Any) -> Figure:
    figure = figures.find(name)(Runner(1), **settings)
    cases = [row.case for row in figure.rows]
    assert len(set(cases)) == len(cases) > 0
    titles = [panel.title for panel in figure.panels]
    assert len(set(titles)) == len(titles) == panels
    written = write(name, figure, folder)
    assert all(path.stat().st_size > 100 for path in written)
    with written[0].open() as file:
        assert {point["panel"] for point in csv.DictReader(file)} <= {*titles}
    assert [row["case"] for row in json.loads(written[2].read_text())["rows"]] == cases
    return figure


def missed(figure: Figure) -> list[str]:
    return [f"{row.case}: {row.measured}" for row in figure.rows if not row.ok]
