"""The gallery shows what the scenarios of reconnaissance print. (`tests/docs/test_gallery.py` tests the rest of it.)"""

import pytest

from tests.support.docs.gallery import assert_printed
from vcmvsp.cosim.scenario import loader

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", [name for name in loader.names() if name.startswith("recon-")])
def test_a_scenario_of_reconnaissance_prints_what_its_gallery_says(name: str) -> None:
    assert_printed(name)
