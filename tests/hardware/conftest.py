"""What several tests of hardware ask for."""

import os
import resource
from collections.abc import Iterator
from contextlib import ExitStack

import pytest


@pytest.fixture
def many_files_open() -> Iterator[None]:
    """More than `select.select` takes: what is opened now has a number above 1023."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    try:
        with ExitStack() as held:
            for _ in range(1024):
                held.callback(os.close, os.open(os.devnull, os.O_RDONLY))
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
