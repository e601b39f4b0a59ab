"""In Jupyter a run shows a bar, its result a table and figures; elsewhere nothing is shown."""

import nbclient
import nbformat
import pytest

import vcmvsp
from vcmvsp.cosim.runs import notebook

CELLS = (
    "import vcmvsp",
    'r = vcmvsp.run("formation-circle", set={"duration_s": 25.0, "physics.kind": "kinematic"}, agents="inprocess", mcap=False)',
    "r",
    "r.plot()",
)


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.sockets
def test_a_notebook_shows_a_bar_numbers_and_figures() -> None:
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(each) for each in CELLS])
    client = nbclient.NotebookClient(book, timeout=120, kernel_name="python3")
    client.execute()
    _, run, result, plot = ("".join(str(each.get("data", {})) for each in cell.outputs) for cell in book.cells)
    assert "text/html" in run  # the bar, empty in the end
    assert "<th>formation error, RMS</th>" in result
    assert result.count("<svg") == plot.count("<svg") == 2


def test_elsewhere_there_is_no_bar_and_a_result_is_one_line() -> None:
    assert notebook.bar("x") is None
    result = vcmvsp.run("formation-circle", set={"duration_s": 0.5}, agents="inprocess", mcap=False)
    assert repr(result).startswith("<Result of run formation-circle, seed 1, 0.5 s")
    assert "\n" not in repr(result)
