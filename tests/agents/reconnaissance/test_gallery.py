"""The gallery shows the output of the reconnaissance scenarios. (The rest is in `tests/docs/test_gallery.py`.)"""

import pytest

from tests.support.docs.gallery import assert_printed
from vcmvsp.cosim.scenario import loader

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", [name for name in loader.names() if name.startswith("recon-")])
def test_a_reconnaissance_scenario_prints_its_gallery_text(name: str) -> None:
    assert_printed(name)
