"""The documented example runs unchanged."""

import re
import time
from pathlib import Path

import pytest

from tests.support.hardware.driver_runs import rest
from vcmvsp import hardware


@pytest.mark.usefixtures("steady")
def test_the_example_drives_a_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", rest)
    page = (Path(hardware.__file__).parent / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, object] = {}
    exec(example, names)
    assert names["sample"] is not None
