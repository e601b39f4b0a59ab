"""What pages say that was chosen or written: a page may send anything of the right type."""

import math
from typing import Any

import viser

from cosim.view.shown import Order


def picked(dropdown: viser.GuiDropdownHandle[str]) -> str:
    """What is chosen of a list; the first, if a page has said what is not on it."""
    return dropdown.value if dropdown.value in dropdown.options else dropdown.options[0]


def is_finite(order: Order) -> bool:
    """Whether all numbers of an order are such as can be meant."""
    values: list[Any] = [getattr(order, field) for field in order.__struct_fields__]
    flat = [part for value in values for part in (value if isinstance(value, tuple) else (value,))]
    return all(math.isfinite(part) for part in flat if isinstance(part, float))
