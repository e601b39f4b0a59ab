"""Changes of a channel during a run: numbers of its layers, and outages of vehicles.

A layer depends on its parameters and the draws of a frame alone: a layer that is rebuilt with another number changes no draw.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.impairments.script import Change, Effects, Script


class Outages(Script):
    """A script that grows during the run: changes that lose every frame from and to some vehicles."""

    cause: ClassVar[str] = "outage"

    @property
    def nothing(self) -> bool:
        """Whether there was no outage yet."""
        return not self.changes

    def _together(self, present: tuple[int, ...], sender: str, receivers: tuple[str, ...]) -> Effects:
        """See `Script._together`; faster for many vehicles, which have the square of links."""
        cut_off = {name for k in present for links in self.changes[k].links for name in links.split("/")}
        passes = np.array([not (sender in cut_off or receiver in cut_off) for receiver in receivers], float)
        return Effects(frozen(passes), frozen(np.zeros(len(receivers))), frozen(np.zeros(len(receivers), np.int64)))


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
            numbers |= {f"radio.{name}.{key}": value for key, value in _numbers(layer).items()}
        return numbers

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Lose every frame from and to these vehicles."""
        links = tuple(expression for name in vehicles for expression in (f"{name}/*", f"*/{name}"))
        change = Change(from_s=from_ns / SECOND_NS, to_s=until_ns / SECOND_NS, links=links, loss=1.0)
        self.outages = Outages((*self.outages.changes, change))

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
        rest = {each.name: getattr(layer, each.name) for each in dataclasses.fields(layer) if each.init}
        del rest[parameter]
        try:
            new = binding.call(type(layer), {parameter: value}, key=f"radio.{name}", given=rest)
        except ScenarioError as error:
            raise ValueError(str(error)) from error
        return {**layers, name: new}


def _numbers(layer: object) -> dict[str, float]:
    """Numeric parameters of a layer."""
    if not dataclasses.is_dataclass(layer):
        return {}
    parameters = {each.name: getattr(layer, each.name) for each in dataclasses.fields(layer) if each.init}
    return {name: value for name, value in parameters.items() if type(value) in (int, float)}
