"""A station of a live run, and a recorded run, shared by the tests of a module."""

from collections.abc import Iterator

import pytest

from tests.support.cosim.recorded_run import Run, observed_run
from tests.support.cosim.view_pages import StationPage, open_station, scenery


@pytest.fixture(scope="module")
def live() -> Iterator[StationPage]:
    """A station of a live run of two robots and a quadrotor."""
    with open_station(scenery(3, flying=1)) as station_page:
        station_page.show(0.0)
        yield station_page


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return observed_run(tmp_path_factory.mktemp("runs") / "run")
