"""What an agent had noted at any time of a recording: of each number and word the newest, whichever note it was in."""

from array import array
from bisect import bisect_right
from collections.abc import Callable
from typing import Any

from vcmvsp.cosim.view.player.decoding import note_of


class Notes:
    """The notes of one vehicle. They are told apart by what they name, and of each sort only the newest is read."""

    def __init__(self) -> None:
        self._sorts: dict[tuple[str, ...], array[int]] = {}  # names -> numbers of the notes that have them
        self._count = 0

    def take(self, _: int, data: bytes) -> None:
        """The next note."""
        self._sorts.setdefault(tuple(note_of(data)), array("q")).append(self._count)
        self._count += 1

    def at(self, number: int, get: Callable[[int], bytes]) -> dict[str, Any]:
        """All that was noted up to the note of this number; ``get`` gives a note by its number."""
        newest = [numbers[place - 1] for numbers in self._sorts.values() if (place := bisect_right(numbers, number))]
        noted: dict[str, Any] = {}
        for each in sorted(newest):
            noted |= note_of(get(each))
        return noted
