"""The rows of the figures."""

from collections.abc import Sequence
from typing import Any

from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.figures.figure import Row, Runner


def rows(name: str, **settings: Any) -> Sequence[Row]:
    """Of one figure; settings are those of the function that makes it."""
    return figures.find(name)(Runner(), **settings).rows
