"""How a run goes on, or a recording is played: pause, go on, one step, how fast, and which instant."""

import math
from collections.abc import Callable

import viser

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.view.messages import Go, Order, Pace, Scenery, Seek
from vcmvsp.cosim.view.page.inputs import picked, write
from vcmvsp.cosim.view.page.state import Known
from vcmvsp.cosim.view.page.style import Every

STEP_NS = SECOND_NS // 10
SPEEDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
FASTEST = "as fast as it can"
HAND_S = 0.7  # after the hand has left the slider, the player moves it again


class Pacing:
    """Pause, go on, one step, and speed. To be made in the context of its container."""

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Callable[[Order], None]) -> None:
        self._give = give
        self._told: Pace | None = None
        self._go = gui.add_button("Go on" if scenery.live else "Play", icon=viser.Icon.PLAYER_PLAY)
        self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._step = gui.add_button("Step 0.1 s", icon=viser.Icon.PLAYER_TRACK_NEXT) if scenery.live else None
        speeds = [_word(each) for each in SPEEDS] + ([FASTEST] if scenery.live else [])
        self._speed = gui.add_dropdown("Speed", speeds, initial_value=FASTEST if scenery.live else _word(1.0))
        self._go.on_click(lambda _: self._order(paused=False))
        self._pause.on_click(lambda _: self._order(paused=True))
        self._speed.on_update(self._chosen)
        if self._step is not None:
            self._step.on_click(lambda _: self._order(paused=True, step_ns=STEP_NS))

    def draw(self, known: Known) -> None:
        """Say what can be ordered now, and which speed is wanted if that has changed."""
        pace = known.pace
        over = bool(pace.over) and known.scenery.live
        self._go.disabled, self._pause.disabled = over or not pace.paused, over or pace.paused
        if self._step is not None:
            self._step.disabled = over
        self._speed.disabled = over
        if self._told is None or self._told.speed != pace.speed:
            word = FASTEST if pace.speed is None else _word(pace.speed)
            if word not in self._speed.options:
                self._speed.options = (*self._speed.options, word)
            write(self._speed, word)
        self._told = pace

    def _chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client_id is not None:  # else it is what `draw` has set
            self._order(paused=self._told is not None and self._told.paused)

    def _order(self, *, paused: bool, step_ns: int = 0) -> None:
        word = picked(self._speed)
        self._give(Go(paused=paused, speed=None if word == FASTEST else float(word[:-1]), step_ns=step_ns))


class Timeline:
    """Which instant of a recording is shown. To be made in the context of its container.

    Args:
        gui: of the page.
        scenery: of the recording.
        give: takes orders.
        clock: of the wall, s.
    """

    def __init__(self, gui: viser.GuiApi, scenery: Scenery, give: Callable[[Order], None], clock: Callable[[], float]) -> None:
        self._give, self._clock = give, clock
        self._end_s = max(scenery.duration_ns / SECOND_NS, 0.01)
        self._hand_s = -HAND_S
        self._often = Every(0.2)
        self._slider = gui.add_slider("Time [s]", 0.0, self._end_s, step=0.01, initial_value=0.0)
        self._slider.on_update(self._moved)

    def draw(self, known: Known) -> None:
        """Let the slider follow the recording, unless a hand is on it."""
        now_s = self._clock()
        if now_s - self._hand_s > HAND_S and self._often.due(now_s):
            write(self._slider, min(round(known.time_ns / SECOND_NS, 2), self._end_s))

    def _moved(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client_id is not None:  # else it is what `draw` has set
            self._hand_s = self._clock()
            time_s = self._slider.value if math.isfinite(self._slider.value) else 0.0
            self._give(Seek(time_ns=seconds_to_ns(min(max(time_s, 0.0), self._end_s))))


def _word(speed: float) -> str:
    return f"{speed:g}x"
