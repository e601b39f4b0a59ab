"""Controls for a run or the player of a recording; only allowed orders have a control.

A control sends an order and does not change by itself: the next update of the run shows the effect.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np
import viser

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import quaternion_from_yaw, yaw_of
from vcmvsp.cosim.scenario.schema import HaltTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.view.messages import End, Go, Order, Pace, Scenery, Seek, Sensors
from vcmvsp.cosim.view.page.drawing import Every
from vcmvsp.cosim.view.page.state import PageState

T = TypeVar("T")
Give = Callable[[Order], None]
Draw = Callable[[PageState], None]
"""Updates which controls are enabled."""

ALL = "all vehicles"
STEP_NS = SECOND_NS // 10
SPEEDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
FASTEST = "as fast as it can"
MARKS = 40  # largest number of marks on the time slider
EVENTS = "previous", "next"
HAND_S = 0.7  # delay after the user's last slider input before the player moves it again


def picked(dropdown: viser.GuiDropdownHandle[str]) -> str:
    """The chosen entry of a list; the first if the page sent an unknown one."""
    return dropdown.value if dropdown.value in dropdown.options else dropdown.options[0]


def write(part: viser.GuiInputHandle[T], value: T) -> None:
    """Set the value of an element of the page."""
    part.value = value  # type: ignore[misc]  # viser has a method between the property and its setter, so mypy misses the setter


def is_finite(order: Order) -> bool:
    """Whether all numbers of an order are finite."""
    parts: list[Any] = []
    for value in msgspec.structs.astuple(order):
        parts += value if isinstance(value, tuple) else (value,)
    return all(math.isfinite(part) for part in parts if isinstance(part, float))


def controls(server: viser.ViserServer, scenery: Scenery, give: Give, clock: Callable[[], float]) -> list[Draw]:
    """Create controls for all allowed orders in the present container of the page."""
    gui, may, parts = server.gui, scenery.may, list[Draw]()
    if "halt" in may:
        parts.append(_stops(gui, give))
    if "pace" in may:
        parts.append(Pacing(gui, scenery, give).draw)
    if "seek" in may:
        parts.append(Timeline(gui, scenery, give, clock).draw)
    if "outage" in may:
        with gui.add_folder("Radio outage", expand_by_default=False):
            parts.append(_outages(gui, scenery, give))
    if "move" in may and any(each.may_be_moved for each in scenery.obstacles):
        with gui.add_folder("Obstacles", expand_by_default=False):
            parts.append(Mover(server, scenery, give).draw)
    if "set" in may and scenery.keys:
        with gui.add_folder("Keys of the scenario", expand_by_default=False):
            parts.append(_changes(gui, scenery, give))
    if "end" in may:
        parts.append(_ends(gui, give))
    return parts


def _until_over(*buttons: viser.GuiButtonHandle) -> Draw:
    """Enable these buttons until the run ends."""

    def draw(state: PageState) -> None:
        for button in buttons:
            button.disabled = bool(state.now.pace.over)

    return draw


def _stops(gui: viser.GuiApi, give: Give) -> Draw:
    """Button that stops all vehicles, or releases them if any is stopped."""
    stop = gui.add_button("Stop all vehicles", color="red", icon=viser.Icon.HAND_STOP)
    go = gui.add_button("Release all vehicles", color="gray")
    stop.on_click(lambda _: give(HaltTable(at_s=0.0, halted=True)))
    go.on_click(lambda _: give(HaltTable(at_s=0.0, halted=False)))

    def draw(state: PageState) -> None:
        stop.disabled = bool(state.now.pace.over)
        go.disabled = stop.disabled or not state.now.halted

    return draw


def _outages(gui: viser.GuiApi, scenery: Scenery, give: Give) -> Draw:
    of = gui.add_dropdown("Frames from and to", [ALL, *(each.name for each in scenery.vehicles)])
    for_s = gui.add_number("are lost for [s]", 5.0, min=0.1, max=3600.0, step=0.1)
    inject = gui.add_button("Inject outage")

    def order(_: object) -> None:
        vehicle = picked(of)
        give(OutageTable(at_s=0.0, vehicles=() if vehicle == ALL else (vehicle,), for_s=for_s.value))

    inject.on_click(order)
    return _until_over(inject)


def _changes(gui: viser.GuiApi, scenery: Scenery, give: Give) -> Draw:
    values = {name: float(value) for name, value in scenery.keys.items()}
    key = gui.add_dropdown("Key", list(values))
    new = gui.add_number("New value", values[picked(key)], step=0.001)
    send = gui.add_button("Set")

    def order(_: object) -> None:
        values[picked(key)] = new.value
        give(SetTable(at_s=0.0, key=picked(key), value=new.value))

    key.on_update(lambda _: write(new, values[picked(key)]))
    send.on_click(order)
    return _until_over(send)


def _ends(gui: viser.GuiApi, give: Give) -> Draw:
    """Button that ends the run after a confirmation."""
    end = gui.add_button("End the run", color="gray")
    yes = gui.add_button("Yes, end it now", color="red", visible=False)
    no = gui.add_button("No, continue", color="gray", visible=False)

    def ask(*, asking: bool) -> None:
        end.visible, yes.visible, no.visible = not asking, asking, asking

    def confirmed(_: object) -> None:
        give(End())
        ask(asking=False)

    end.on_click(lambda _: ask(asking=True))
    no.on_click(lambda _: ask(asking=False))
    yes.on_click(confirmed)
    return _until_over(end, yes)


class Pacing:
    """Pause and resume (one button, which names what a click does), single step, and speed."""

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Give) -> None:
        self._give, self._live = give, scenery.live
        self._pace: Pace | None = None
        self._resume = "Resume" if self._live else "Play"
        self._toggle = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._step = gui.add_button("Step 0.1 s", icon=viser.Icon.PLAYER_TRACK_NEXT) if self._live else None
        speeds = [*map(_word, SPEEDS), *([FASTEST] if self._live else [])]
        self._speed = gui.add_dropdown("Speed", speeds, initial_value=FASTEST if self._live else _word(1.0))
        self._toggle.on_click(lambda _: self._order(paused=self._toggle.label == "Pause"))
        self._speed.on_update(self._chosen)
        if self._step is not None:
            self._step.on_click(lambda _: self._order(paused=True, step_ns=STEP_NS))

    def draw(self, state: PageState) -> None:
        """Update the enabled controls, and the target speed if it has changed."""
        pace = state.now.pace
        over = bool(pace.over) and self._live
        self._toggle.disabled = over
        if self._pace is None or self._pace.paused != pace.paused:
            self._toggle.label = self._resume if pace.paused else "Pause"
            self._toggle.icon = viser.Icon.PLAYER_PLAY if pace.paused else viser.Icon.PLAYER_PAUSE
        if self._step is not None:
            self._step.disabled = over
        self._speed.disabled = over
        if self._pace is None or self._pace.speed != pace.speed:
            word = _word(pace.speed)
            if word not in self._speed.options:
                self._speed.options = (*self._speed.options, word)
            write(self._speed, word)
        self._pace = pace

    def _chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client_id is not None:  # else `draw` has set it
            self._order(paused=self._pace is not None and self._pace.paused)

    def _order(self, *, paused: bool, step_ns: int = 0) -> None:
        word = picked(self._speed)
        self._give(Go(paused=paused, speed=None if word == FASTEST else float(word[:-1]), step_ns=step_ns))


def _word(speed: float | None) -> str:
    return FASTEST if speed is None else f"{speed:g}x"


def apart(times_s: Sequence[float], least_s: float) -> tuple[float, ...]:
    """The increasing times without those that follow the last one kept by less than ``least_s``."""
    instants: list[float] = []
    for time_s in times_s:
        if not instants or time_s - instants[-1] >= least_s:
            instants.append(time_s)
    return tuple(instants)


class Timeline:
    """Time slider of a recording, with marks where its log has lines, and buttons to the next and the previous line."""

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Give, clock: Callable[[], float]) -> None:
        self._give, self._clock = give, clock
        self._end_s = max(scenery.duration_ns / SECOND_NS, 0.01)
        self._hand_s, self._now_ns = -HAND_S, 0
        self._often = Every(0.2)
        self._events_ns = sorted(scenery.events_ns)
        marks = apart([time_ns / SECOND_NS for time_ns in self._events_ns], self._end_s / MARKS)
        self._slider = gui.add_slider("Time [s]", 0.0, self._end_s, step=0.01, initial_value=0.0, marks=marks or None)
        self._slider.on_update(self._moved)
        if self._events_ns:
            events = gui.add_button_group("Event", EVENTS)
            events.on_click(lambda _: self._go_to_event(later=events.value == EVENTS[1]))

    def draw(self, state: PageState) -> None:
        """Move the slider with the recording, unless the user drags it."""
        self._now_ns = state.now.time_ns
        now_s = self._clock()
        if now_s - self._hand_s > HAND_S and self._often.due(now_s):
            write(self._slider, min(round(state.now.time_ns / SECOND_NS, 2), self._end_s))

    def _go_to_event(self, *, later: bool) -> None:
        place = bisect_right(self._events_ns, self._now_ns) if later else bisect_left(self._events_ns, self._now_ns) - 1
        if 0 <= place < len(self._events_ns):
            self._give(Seek(time_ns=self._events_ns[place]))

    def _moved(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client_id is not None:  # else `draw` has set it
            self._hand_s = self._clock()
            time_s = self._slider.value if math.isfinite(self._slider.value) else 0.0
            self._give(Seek(time_ns=seconds_to_ns(min(max(time_s, 0.0), self._end_s))))


class Mover:
    """Moves an obstacle, by numbers or by dragging; at least one obstacle must be movable."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery, give: Give) -> None:
        self._give = give
        self._pose = {each.name: each.pose for each in scenery.obstacles if each.may_be_moved}
        gui = server.gui
        self._which = gui.add_dropdown("Obstacle", list(self._pose))
        self._x = gui.add_number("x [m]", 0.0, step=0.1)
        self._y = gui.add_number("y [m]", 0.0, step=0.1)
        self._yaw = gui.add_number("yaw [rad]", 0.0, step=0.05)
        self._move = gui.add_button("Move obstacle")
        self._dragged = gui.add_checkbox("Drag", initial_value=False)
        self._gizmo = server.scene.add_transform_controls(
            "/gizmo", scale=1.5, active_axes=(True, True, False), disable_rotations=False, visible=False
        )
        self._which.on_update(lambda _: self._begin())
        self._move.on_click(lambda _: self._send())
        self._dragged.on_update(lambda _: self._begin())
        self._gizmo.on_update(self._drag)
        self._begin()

    def draw(self, state: PageState) -> None:
        """Update the poses of obstacles and whether the run is over."""
        for name, pose in state.now.obstacles.items():
            if name in self._pose:
                self._pose[name] = pose
        over = bool(state.now.pace.over)
        self._move.disabled = self._dragged.disabled = over
        if over:
            self._gizmo.visible = False

    def _begin(self) -> None:
        x, y, z, yaw = self._pose[picked(self._which)]
        self._write(x, y, yaw)
        self._gizmo.position, self._gizmo.wxyz = (x, y, z), quaternion_from_yaw(yaw)
        self._gizmo.visible = self._dragged.value and not self._dragged.disabled

    def _drag(self, event: viser.TransformControlsEvent) -> None:
        w, x, y, z = np.asarray(event.target.wxyz, float).tolist()
        self._write(float(event.target.position[0]), float(event.target.position[1]), yaw_of((w, x, y, z)))
        if event.phase == "end":
            self._send()

    def _write(self, x: float, y: float, yaw: float) -> None:
        for part, number in ((self._x, x), (self._y, y), (self._yaw, yaw)):
            write(part, round(number, 3))

    def _send(self) -> None:
        self._give(
            MoveTable(at_s=0.0, obstacle=picked(self._which), position=(self._x.value, self._y.value), yaw=self._yaw.value)
        )


class Choice:
    """The chosen vehicle. Create it in the context of its container.

    Readings for display cost the run computing time: a `Sensors` order requests them for the chosen vehicle only, while a page
    is open.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery, give: Give) -> None:
        self._server, self._scenery, self._give = server, scenery, give
        self._row = {each.name: row for row, each in enumerate(scenery.vehicles)}
        gui, may = server.gui, scenery.may
        self._ticked: set[str] = set()  # names of sensors, of any vehicle
        self._boxes: list[viser.GuiCheckboxHandle] = []
        self._names: tuple[str, ...] = ()
        self._which = gui.add_dropdown("Vehicle", list(self._row) or ["none"])
        self._follows = gui.add_checkbox("Camera follows", initial_value=False)
        labels = ("Stop this vehicle", "Release this vehicle") if "halt" in may and self._row else ()
        self._stops = [gui.add_button(label) for label in labels]
        self._sensors = gui.add_folder("Show its readings", visible=False)
        self._which.on_update(lambda _: self._changed())
        for button, halted in zip(self._stops, (True, False), strict=False):
            button.on_click(self._halts(halted))
        server.on_client_connect(lambda _: self._ask())
        server.on_client_disconnect(lambda _: self._ask())
        self._changed()

    @property
    def name(self) -> str:
        """Name of the chosen vehicle; empty without vehicles."""
        return picked(self._which) if self._row else ""

    @property
    def row(self) -> int:
        """Index of the chosen vehicle in the scenery."""
        return self._row.get(self.name, 0)

    @property
    def follows(self) -> bool:
        """Whether the camera follows the chosen vehicle."""
        return self._follows.value

    @property
    def readings(self) -> tuple[str, ...]:
        """Readings to show of the chosen vehicle: vehicle/sensor."""
        if not self._row:
            return ()
        sensors = self._scenery.vehicles[self.row].sensors
        return tuple(f"{self.name}/{sensor}" for sensor in sensors if sensor in self._ticked)

    def choose(self, row: int) -> None:
        """Choose another vehicle."""
        write(self._which, self._scenery.vehicles[row].name)

    def draw(self, state: PageState) -> None:
        """Update the enabled controls."""
        for button, stops in zip(self._stops, (True, False), strict=False):
            button.disabled = bool(state.now.pace.over) or (self.name in state.now.halted) is stops

    def _changed(self) -> None:
        """Offer the sensors of the chosen vehicle; equal names stay ticked."""
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
        return lambda _: self._give(HaltTable(at_s=0.0, vehicles=(self.name,), halted=halted))

    def _ticks(self, sensor: str) -> Callable[[viser.GuiEvent[viser.GuiCheckboxHandle]], None]:
        return lambda event: self._tick(sensor, event.target.value)

    def _tick(self, sensor: str, ticked: bool) -> None:
        (self._ticked.add if ticked else self._ticked.discard)(sensor)
        self._ask()

    def _ask(self) -> None:
        names = self.readings if self._server.get_clients() else ()
        if names != self._names:
            self._names = names
            self._give(Sensors(names=names))
