"""Changes of a channel during a run: numbers of its layers, and outages of vehicles.

A layer depends on its parameters and the draws of a frame alone: a layer that is rebuilt with another number changes no draw.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Frame


@dataclass(frozen=True)
class Outages:
    """Losses of every frame from and to some vehicles that is on the air at any time of ``[from_ns, until_ns)``."""

    spans: tuple[tuple[frozenset[str], int, int], ...] = ()  # vehicles, from_ns, until_ns
    cause: ClassVar[str] = "outage"

    @property
    def nothing(self) -> bool:
        """Whether there was no outage yet."""
        return not self.spans

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        present = [names for names, begin, end in self.spans if begin < frame.end_ns and frame.start_ns < end]
        cut_off = frozenset().union(*present)
        return np.array([frame.sender in cut_off or receiver in cut_off for receiver in frame.receivers], np.bool_)


class RuntimeChanges:
    """The current layers, and the outages so far.

    Numeric fields of layers that are dataclasses may change; their keys are those of the scenario: ``radio.loss.probability``.
    """

    def __init__(self, **layers: Any) -> None:
        self._first: Mapping[str, Any] = layers
        self.start()

    def start(self) -> None:
        """Undo all changes and outages."""
        self.layers, self.outages = self._first, Outages()

    def numbers(self) -> dict[str, float]:
        """Keys and values of the numbers that may change."""
        numbers: dict[str, float] = {}
        for name, layer in self.layers.items():
            parameters = _parameters(layer) if dataclasses.is_dataclass(layer) else {}
            numbers |= {f"radio.{name}.{key}": value for key, value in parameters.items() if type(value) in (int, float)}
        return numbers

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Lose every frame from and to these vehicles."""
        self.outages = Outages((*self.outages.spans, (frozenset(vehicles), from_ns, until_ns)))

    def change(self, key: str, value: float) -> None:
        """Change a number; see `changed`."""
        self.layers = self.changed(self.layers, key, value)

    def check(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Check a change after earlier ones without making it; see `changed`."""
        layers = self.layers
        for before in (*earlier, (key, value)):
            layers = self.changed(layers, *before)

    def changed(self, layers: Mapping[str, Any], key: str, value: float) -> dict[str, Any]:
        """The layers with one number changed.

        Raises:
            ValueError: unknown key, or invalid value.
        """
        if key not in self.numbers():
            raise ValueError(f"{key} cannot change during a run; what can: {', '.join(self.numbers()) or 'nothing'}")
        _, name, parameter = key.split(".")
        layer = layers[name]
        rest = {name: value for name, value in _parameters(layer).items() if name != parameter}
        try:
            new = binding.call(type(layer), {parameter: value}, key=f"radio.{name}", given=rest)
        except ScenarioError as error:
            raise ValueError(str(error)) from error
        return {**layers, name: new}


def _parameters(layer: Any) -> dict[str, Any]:
    return {each.name: getattr(layer, each.name) for each in dataclasses.fields(layer) if each.init}
