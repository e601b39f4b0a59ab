"""Meanings of parameters are read from their definitions."""

from dataclasses import dataclass
from typing import Any

import msgspec

from vcmvsp.cosim.reference.describe import meanings, summary


@dataclass(frozen=True)
class Sky:
    """Whatever is above.

    With a second paragraph.
    """

    height_m: float  # above the floor
    # So long that it stands above,
    # in two lines.
    clouds: tuple[str, ...] = (
        "cirrus",  # by name,
    )  # in any order.
    other: str = "# this is no comment"
    none: int = 0

    def reach(self) -> float:  # not a parameter
        return self.height_m


@dataclass(frozen=True)
class Storm(Sky):
    speed: float = 0.0  # of the wind
    height_m: float = 9.0  # of the anvil


class Rain:
    """It rains.

    Args:
        db_per_km: what it
            takes: much.
        fine, sleet: how it falls.
            1. As drops.

    Returns:
        nothing: at all.
    """

    def __init__(self, db_per_km: float, *, fine: bool = True, sleet: bool = False) -> None:
        self.all = (db_per_km, fine, sleet)


class Drop(msgspec.Struct):
    """One drop.

    Args:
        size: of it.
    """

    size: float  # hidden by what Args says
    place: float = 0.0  # where


def test_comments_behind_a_field_and_in_the_lines_above_it() -> None:
    assert meanings(Sky) == {
        "height_m": "above the floor",
        "clouds": "So long that it stands above, in two lines. by name, in any order",
    }


def test_missing_meanings_come_from_the_base_class() -> None:
    assert meanings(Storm) == {**meanings(Sky), "height_m": "of the anvil", "speed": "of the wind"}


def test_the_args_section_ends_at_the_next_and_wins_over_comments() -> None:
    meaning = "how it falls. 1. As drops"
    assert meanings(Rain) == {"db_per_km": "what it takes: much", "fine": meaning, "sleet": meaning}
    assert meanings(Drop) == {"size": "of it", "place": "where"}


def test_no_documentation_is_no_meaning() -> None:
    def plain(size: Any) -> Any:
        return size

    assert meanings(plain) == {}
    assert (summary(plain), summary(Sky)) == ("", "Whatever is above.")
