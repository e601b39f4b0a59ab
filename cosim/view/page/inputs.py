"""What pages say that was chosen or written, for a page may send anything of the right type; and what is written for them."""

import math
from typing import Any, TypeVar

import viser

from vcmvsp.cosim.view.messages import Order

T = TypeVar("T")


def picked(dropdown: viser.GuiDropdownHandle[str]) -> str:
    """What is chosen of a list; the first, if a page has said what is not on it."""
    return dropdown.value if dropdown.value in dropdown.options else dropdown.options[0]


def write(part: viser.GuiInputHandle[T], value: T) -> None:
    """Let an element of the page have this value."""
    part.value = value  # type: ignore[misc]  # viser has a method between the property and its setter, so mypy misses the setter


def is_finite(order: Order) -> bool:
    """Whether all numbers of an order are such as can be meant."""
    values: list[Any] = [getattr(order, field) for field in order.__struct_fields__]
    flat = [part for value in values for part in (value if isinstance(value, tuple) else (value,))]
    return all(math.isfinite(part) for part in flat if isinstance(part, float))
