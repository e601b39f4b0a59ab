"""The example of the part's page works as it stands."""

import re
from pathlib import Path

import hardware


def test_the_example_drives_a_robot() -> None:
    page = (Path(hardware.__file__).parent / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, object] = {}
    exec(example, names)
    assert names["sample"] is not None
