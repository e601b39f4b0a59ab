"""What the one who looks may order of a run, or of the player of a recording; only what is obeyed has a control.

A control gives an order and shows nothing of its own: that it was obeyed is seen in what the run shows next.
"""

from collections.abc import Callable
from typing import Protocol

import viser

from vcmvsp.cosim.view.messages import Change, End, Halt, Order, Outage, Scenery
from vcmvsp.cosim.view.page.inputs import picked, write
from vcmvsp.cosim.view.page.obstacle_control import Mover
from vcmvsp.cosim.view.page.pace_control import Pacing, Timeline
from vcmvsp.cosim.view.page.state import Known

ALL = "all vehicles"
Give = Callable[[Order], None]


class Part(Protocol):
    """A group of controls."""

    def draw(self, known: Known) -> None:
        """Say what can be ordered now."""


def controls(server: viser.ViserServer, scenery: Scenery, give: Give, clock: Callable[[], float]) -> list[Part]:
    """The controls of all that is obeyed, made in the present container of the page.

    Args:
        server: of the page.
        scenery: of the run.
        give: takes orders, in threads of the page's server.
        clock: of the wall, s.
    """
    gui, may, parts = server.gui, scenery.may, list[Part]()
    if "halt" in may:
        parts.append(Stops(gui, give))
    if "pace" in may:
        parts.append(Pacing(gui, scenery, give))
    if "seek" in may:
        parts.append(Timeline(gui, scenery, give, clock))
    if "outage" in may:
        with gui.add_folder("Radio outage", expand_by_default=False):
            parts.append(Outages(gui, scenery, give))
    if "move" in may and any(each.may_be_moved for each in scenery.obstacles):
        with gui.add_folder("Obstacles", expand_by_default=False):
            parts.append(Mover(server, scenery, give))
    if "set" in may and scenery.keys:
        with gui.add_folder("Keys of the scenario", expand_by_default=False):
            parts.append(Changes(gui, scenery, give))
    if "end" in may:
        parts.append(Ends(gui, give))
    return parts


class Stops:
    """Stop all vehicles, or let them go."""

    def __init__(self, gui: viser.GuiApi, give: Give) -> None:
        self._stop = gui.add_button("STOP ALL", color="red", icon=viser.Icon.HAND_STOP)
        self._go = gui.add_button("Let all go", color="gray")
        self._stop.on_click(lambda _: give(Halt(halted=True)))
        self._go.on_click(lambda _: give(Halt(halted=False)))

    def draw(self, known: Known) -> None:
        """Stopping is possible for as long as the run goes on, letting go if anything is stopped."""
        self._stop.disabled = bool(known.pace.over)
        self._go.disabled = bool(known.pace.over) or not known.halted


class Outages:
    """Let frames be lost."""

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Give) -> None:
        of = gui.add_dropdown("Frames from and to", [ALL, *(each.name for each in scenery.vehicles)])
        for_s = gui.add_number("are lost for [s]", 5.0, min=0.1, max=3600.0, step=0.1)
        self._inject = gui.add_button("Inject outage")
        self._inject.on_click(lambda _: give(Outage(vehicles=_named(picked(of)), for_s=for_s.value)))

    def draw(self, known: Known) -> None:
        """Possible for as long as the run goes on."""
        self._inject.disabled = bool(known.pace.over)


class Changes:
    """Give a key of the scenario another value."""

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Give) -> None:
        self._give = give
        self._values = {key: float(value) for key, value in scenery.keys.items()}
        self._key = gui.add_dropdown("Key", list(self._values))
        self._value = gui.add_number("New value", self._values[picked(self._key)], step=0.001)
        self._set = gui.add_button("Set")
        self._key.on_update(lambda _: self._begin())
        self._set.on_click(lambda _: self._send())

    def draw(self, known: Known) -> None:
        """Possible for as long as the run goes on."""
        self._set.disabled = bool(known.pace.over)

    def _begin(self) -> None:
        write(self._value, self._values[picked(self._key)])

    def _send(self) -> None:
        key, value = picked(self._key), self._value.value
        self._values[key] = value
        self._give(Change(key=key, value=value))


class Ends:
    """End the run, when it was said twice."""

    def __init__(self, gui: viser.GuiApi, give: Give) -> None:
        self._end = gui.add_button("End the run", color="gray")
        self._yes = gui.add_button("Yes, end it now", color="red", visible=False)
        self._no = gui.add_button("No, let it go on", color="gray", visible=False)
        self._end.on_click(lambda _: self._ask(asking=True))
        self._no.on_click(lambda _: self._ask(asking=False))
        self._yes.on_click(lambda _: self._confirmed(give))

    def draw(self, known: Known) -> None:
        """Possible for as long as the run goes on."""
        self._end.disabled = self._yes.disabled = bool(known.pace.over)

    def _ask(self, *, asking: bool) -> None:
        self._end.visible, self._yes.visible, self._no.visible = not asking, asking, asking

    def _confirmed(self, give: Give) -> None:
        give(End())
        self._ask(asking=False)


def _named(choice: str) -> tuple[str, ...]:
    return () if choice == ALL else (choice,)
