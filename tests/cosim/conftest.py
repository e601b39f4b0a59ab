"""Fixtures of the tests of the core."""

from pathlib import Path

import pytest

from tests.support.cosim.command_line import two_cars


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder of a test, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def folder(here: Path) -> Path:
    """The current folder of a test, with the scenario ``s.toml`` of two cars."""
    (here / "s.toml").write_text(two_cars())
    return here
