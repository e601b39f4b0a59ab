"""File access of the readers: missing files, libraries that are not installed."""

import importlib
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.util import limits


def require_file(path: str) -> None:
    """Refuse a missing file, at the key ``path``."""
    if not Path(path).is_file():
        raise ScenarioError(f"there is no file {path}", key="path")


def text_of(path: Path) -> str:
    """The text of a file.

    Raises:
        ScenarioError: it cannot be read, or is no UTF-8.
    """
    try:
        return limits.read_text(path)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"cannot be read as text: {error}", source=str(path)) from error


def library(name: str, path: str, install: str) -> Any:
    """Import an optional library that a file needs.

    Args:
        name: of the module.
        path: of the file, for the message.
        install: arguments of ``pip install``.

    Raises:
        ScenarioError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ScenarioError(f"reading it needs {name}, which is not installed: pip install {install}", source=path) from error
