"""Which vehicle is looked at, whether the camera goes along, and which of its sensors are shown."""

from collections.abc import Callable

import viser

from vcmvsp.cosim.view.messages import Halt, Order, Scenery, Sensors
from vcmvsp.cosim.view.page.inputs import picked, write
from vcmvsp.cosim.view.page.state import Known


class Choice:
    """The chosen vehicle; to be made in the context of its container.

    What a sensor shows costs the run time: it is asked for by a `Sensors` order, of the chosen vehicle alone, and only while
    somebody looks.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery, give: Callable[[Order], None]) -> None:
        self._server, self._scenery, self._give = server, scenery, give
        self._row = {each.name: row for row, each in enumerate(scenery.vehicles)}
        gui, may = server.gui, scenery.may
        self._ticked: set[str] = set()  # names of sensors, of whichever vehicle
        self._boxes: list[viser.GuiCheckboxHandle] = []
        self._asked: tuple[str, ...] = ()
        self._pages = len(server.get_clients())
        self._which = gui.add_dropdown("Vehicle", list(self._row) or ["none"])
        self._follows = gui.add_checkbox("Camera follows", initial_value=False)
        self._stops = [gui.add_button("Stop this vehicle"), gui.add_button("Let it go")] if "halt" in may and self._row else []
        self._sensors = gui.add_folder("Show its readings", visible=False)
        self._which.on_update(lambda _: self._changed())
        for button, halted in zip(self._stops, (True, False), strict=False):
            button.on_click(self._halts(halted))
        server.on_client_connect(lambda _: self._ask())
        server.on_client_disconnect(lambda _: self._ask())
        self._changed()

    @property
    def name(self) -> str:
        """Of the chosen vehicle; empty if there are none."""
        return picked(self._which) if self._row else ""

    @property
    def row(self) -> int:
        """Its place among the scenery's."""
        return self._row.get(self.name, 0)

    @property
    def follows(self) -> bool:
        """Whether the camera goes along with it."""
        return self._follows.value

    @property
    def readings(self) -> tuple[str, ...]:
        """What is to be shown of it: vehicle/sensor."""
        if not self._row:
            return ()
        sensors = self._scenery.vehicles[self.row].sensors
        return tuple(f"{self.name}/{sensor}" for sensor in sensors if sensor in self._ticked)

    def choose(self, row: int) -> None:
        """Choose another one."""
        write(self._which, self._scenery.vehicles[row].name)

    def draw(self, known: Known) -> None:
        """Say what can be ordered now."""
        for button, stops in zip(self._stops, (True, False), strict=False):
            button.disabled = bool(known.pace.over) or (self.name in known.halted) is stops

    def _changed(self) -> None:
        """Offer the sensors of the vehicle that is chosen now; those of the same names stay ticked."""
        for box in self._boxes:
            box.remove()
        self._boxes = []
        sensors = self._scenery.vehicles[self.row].sensors if self._row and "sensors" in self._scenery.may else {}
        self._sensors.visible = bool(sensors)
        with self._sensors:
            for sensor, kind in sensors.items():
                box = self._server.gui.add_checkbox(f"{sensor} ({kind})", initial_value=sensor in self._ticked)
                box.on_update(self._ticks(sensor))
                self._boxes.append(box)
        self._ask()

    def _halts(self, halted: bool) -> Callable[[object], None]:
        return lambda _: self._give(Halt(vehicles=(self.name,), halted=halted))

    def _ticks(self, sensor: str) -> Callable[[viser.GuiEvent[viser.GuiCheckboxHandle]], None]:
        return lambda event: self._tick(sensor, event.target.value)

    def _tick(self, sensor: str, ticked: bool) -> None:
        (self._ticked.add if ticked else self._ticked.discard)(sensor)
        self._ask()

    def _ask(self) -> None:
        """Order the readings that are wanted, if they are other ones."""
        wanted = self.readings if self._server.get_clients() else ()
        if wanted != self._asked:
            self._asked = wanted
            self._give(Sensors(names=wanted))
