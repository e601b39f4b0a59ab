"""What an operator changes of a channel while a run goes on: numbers of its layers, and who is cut off for a while.

A layer answers from its parameters and the draws of a frame alone. So one that is built anew with another number goes on from
there as if it had had that number all the time; nothing is drawn twice, and no other frame is drawn differently.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.impairments.script import Effects, Script, ScriptedChange


class Outages(Script):
    """Changes that lose every frame from and to some vehicles: a script that is written while the run goes on."""

    cause: ClassVar[str] = "outage"

    @property
    def nothing(self) -> bool:
        """Whether there was none yet."""
        return not self.changes

    def _together(self, present: tuple[int, ...], sender: str, receivers: tuple[str, ...]) -> Effects:
        """As of any script, but quicker: a hundred vehicles that are cut off together have ten thousand links."""
        cut_off = {name for k in present for links in self.changes[k].links for name in links.split("/")}
        passes = np.array([not (sender in cut_off or receiver in cut_off) for receiver in receivers], float)
        return Effects(frozen(passes), frozen(np.zeros(len(receivers))), frozen(np.zeros(len(receivers), np.int64)))


class RuntimeChanges:
    """Layers as they are now, and the outages so far.

    Numbers that may change are fields of layers that are dataclasses. Their keys are those of a scenario:
    ``radio.loss.probability``.

    Args:
        layers: by their names, as the run begins.

    Attributes:
        layers: as they are now.
        outages: all so far.
    """

    def __init__(self, **layers: Any) -> None:
        self._first: Mapping[str, Any] = layers
        self.start()

    def start(self) -> None:
        """Begin anew: nobody has done anything."""
        self.layers, self.outages = self._first, Outages()

    def numbers(self) -> dict[str, float]:
        """The numbers that may change, and what they are now."""
        return {f"radio.{name}.{key}": value for name, layer in self.layers.items() for key, value in _numbers(layer).items()}

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """Have every frame lost from and to these vehicles."""
        links = tuple(expression for name in vehicles for expression in (f"{name}/*", f"*/{name}"))
        change = ScriptedChange(from_s=from_ns / SECOND_NS, to_s=until_ns / SECOND_NS, links=links, loss=1.0)
        self.outages = Outages((*self.outages.changes, change))

    def change(self, key: str, value: float) -> None:
        """Give a number another value; see `changed`."""
        self.layers = self.changed(self.layers, key, value)

    def check(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Refuse a change that cannot be made, after those that come before it; see `changed`."""
        layers = self.layers
        for before in (*earlier, (key, value)):
            layers = self.changed(layers, *before)

    def changed(self, layers: Mapping[str, Any], key: str, value: float) -> dict[str, Any]:
        """The layers with one number of one of them changed.

        Raises:
            ValueError: there is no such number, or it cannot be this one.
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
    """The parameters of a layer that are numbers."""
    if not dataclasses.is_dataclass(layer):
        return {}
    found = {each.name: getattr(layer, each.name) for each in dataclasses.fields(layer) if each.init}
    return {name: value for name, value in found.items() if type(value) in (int, float)}
