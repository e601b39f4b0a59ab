"""The control station: a web page that shows a live or recorded run and takes orders. All open pages show the same.

Frequent changes are sent as a few arrays, and only to open pages; the page loads nothing from other servers.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Order, PageUpdate, Scenery
from vcmvsp.cosim.view.page.cameras import Follower, Overview
from vcmvsp.cosim.view.page.charts import Charts
from vcmvsp.cosim.view.page.controls import Choice, controls, is_finite, picked
from vcmvsp.cosim.view.page.drawing import Every
from vcmvsp.cosim.view.page.panel import SORTED, log_page, run_page, team_page, vehicle_page
from vcmvsp.cosim.view.page.ray_paths import RayPaths
from vcmvsp.cosim.view.page.scene import Scene
from vcmvsp.cosim.view.page.sensors import GROUNDS, Ground, Pictures, Scans
from vcmvsp.cosim.view.page.state import PageState
from vcmvsp.cosim.view.page.vehicles import WHICH, Fixes, Ghosts, Links, Trails, Vehicles, legend

LEFT_PX, RIGHT_PX = 300.0, 360.0
LEGEND_PX = 230.0
WORDS_S = 0.2  # between two updates of texts
TABLE_S = 1.0  # between two updates of the table of all vehicles
IDLE_S = 0.1  # redraw interval without updates


class Station:
    """The page of a run."""

    def __init__(
        self,
        server: viser.ViserServer,
        scenery: Scenery,
        order: Callable[[Order], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._server, self._clock = server, clock
        self._order, self._ordering = order, threading.Lock()
        self._drawing, self._has_drawn = threading.RLock(), threading.Event()
        self._state = PageState(scenery)
        self._aimed = False
        self._words, self._often, self._line_count = Every(WORDS_S), Every(TABLE_S), -1
        with server.atomic():
            self._scene = Scene(server, scenery)
            self._vehicles = Vehicles(server, scenery, self._clicked)
            self._trails, self._links = Trails(server, scenery), Links(server, scenery)
            self._ghosts, self._fixes = Ghosts(server, scenery), Fixes(server, scenery)
            self._scans, self._ground = Scans(server, scenery), Ground(server)
            self._overview = Overview(server, *self._scene.floor.extent)
            self._follower, self._team = Follower(server), Follower(server, math.inf)
            self._build(server, scenery)
        threading.Thread(target=self._keep, name="station", daemon=True).start()

    def show(self, *updates: PageUpdate) -> None:
        """Show updates. Call from one thread, at most some thirty times a second."""
        state, now_s = self._state, self._clock()
        with self._drawing:
            for update in updates:
                state.take(update)
            self._trails.sample(state)
            self._charts.sample(state, now_s)
            if not self._aimed:
                places = self._known_places()
                self._aimed = len(places) > 0 or not state.names
                self._overview.aim(places, now_s)
            if self._server.get_clients():
                self.draw()

    def draw(self, *, texts: bool = False) -> None:
        """Send changes to the pages; ``texts``: all texts, even if some were sent a moment ago."""
        self._has_drawn.set()
        state, choice, now_s = self._state, self._choice, self._clock()
        with self._drawing:
            self._go_along()
        with self._drawing, self._server.atomic():
            self._scene.draw(state, now_s)
            self._vehicles.draw(state, choice.row, now_s)
            self._ghosts.draw(state)
            self._fixes.draw(state, now_s)
            self._trails.draw(now_s)
            self._links.draw(state, choice.row)
            self._paths.draw(state, choice.row)
            self._scans.draw(state, choice.readings)
            self._ground.draw(state, choice.name, now_s)
            self._pictures.draw(state, choice.name, choice.readings, now_s)
            self._charts.draw(choice.row)
            if self._words.due(now_s) or texts:
                self._write()

    def _go_along(self) -> None:
        places, now_s = self._known_places(), self._clock()
        if self._choice.follows:
            self._follower.draw(self._state.position[self._choice.row], now_s)
        else:
            self._follower.release()
        if self._with_team.value and not self._choice.follows and len(places):
            self._team.draw(places.mean(axis=0), now_s)
        else:
            self._team.release()
        if not (self._choice.follows or self._with_team.value):
            self._overview.draw(places, now_s)

    def _fit(self) -> None:
        with self._drawing:
            self._team.release()
            self._overview.fit(self._known_places(), self._clock())

    def _known_places(self) -> Array:
        position = self._state.position
        return position[np.isfinite(position).all(axis=1)]

    def _keep(self) -> None:
        """Redraw without updates, too, for new choices and newly opened pages."""
        loop = self._server.get_event_loop()
        while loop.is_running():
            if not self._has_drawn.wait(IDLE_S) and self._server.get_clients():
                self.draw()
            self._has_drawn.clear()
            time.sleep(IDLE_S)

    def _write(self) -> None:
        state = self._state
        self._run.content = run_page(state)
        self._vehicle.content = vehicle_page(state, self._choice.row)
        if self._often.due(self._clock()):
            self._all.content = team_page(state, picked(self._sorted))
        if state.line_count != self._line_count:
            self._line_count = state.line_count
            self._log.content = log_page(state)
        for draw in (self._choice.draw, *self._controls):
            draw(state)

    def _clicked(self, row: int) -> None:
        self._choice.choose(row)

    def _give(self, order: Order) -> None:
        if is_finite(order):
            with self._ordering:
                self._order(order)

    def _build(self, server: viser.ViserServer, scenery: Scenery) -> None:
        """Build the page: controls on the left, information on the right."""
        gui = server.gui
        gui.set_panel_label(f"VCMVSP: {scenery.scenario}")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(LEFT_PX)
        self._run = gui.add_html(run_page(self._state))
        self._controls = controls(server, scenery, self._give, self._clock)
        gui.add_button("Fit all", icon=viser.Icon.MAXIMIZE).on_click(lambda _: self._fit())
        self._with_team = gui.add_checkbox("Follow team", initial_value=False)
        with gui.add_folder("View", expand_by_default=False):
            self._build_view(gui)
        with gui.add_folder("Log"):
            self._log = gui.add_html(log_page(self._state))
        panel = gui.add_panel()
        with panel.add_tab("Vehicle"):
            self._choice = Choice(server, scenery, self._give)
            self._vehicle = gui.add_html(vehicle_page(self._state, 0))
            self._paths = RayPaths(server, scenery)
            self._pictures = Pictures(server, scenery)
        with panel.add_tab("All vehicles"):
            self._sorted = gui.add_dropdown("Sort by", SORTED)
            self._all = gui.add_html(team_page(self._state, SORTED[0]))
        with panel.add_tab("Charts"):
            self._charts = Charts(server, scenery)
        key = gui.add_panel()
        with key.add_tab("Legend"):
            gui.add_html(legend())
        key.float(x=12.0, y=-12.0, width=LEGEND_PX)
        panel.dock_right()
        panel.set_width(RIGHT_PX)
        self._look(dark=False)

    def _build_view(self, gui: viser.GuiApi) -> None:
        nodes_of: dict[str, Sequence[viser.SceneNodeHandle]] = {
            "Trails": self._trails.nodes,
            "Formation": self._ghosts.nodes,
            "Fixes": self._fixes.nodes,
        }
        _tick(gui, "Names", self._vehicles.labels, at_first=self._vehicles.names_at_first)
        for label, nodes in nodes_of.items():
            _tick(gui, label, nodes)
        links = gui.add_dropdown("Links", WHICH, initial_value=self._links.which)
        links.on_update(lambda _: setattr(self._links, "which", picked(links)))
        ground = gui.add_dropdown("On the floor", GROUNDS)
        ground.on_update(lambda _: setattr(self._ground, "kind", picked(ground)))
        dark = gui.add_checkbox("Dark", initial_value=False)
        dark.on_update(lambda event: self._look(dark=event.target.value))

    def _look(self, *, dark: bool) -> None:
        self._server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self._scene.darken(dark)
        self._charts.darken(dark)


def _tick(gui: viser.GuiApi, label: str, nodes: Sequence[viser.SceneNodeHandle], *, at_first: bool = True) -> None:

    def show(event: viser.GuiEvent[viser.GuiCheckboxHandle]) -> None:
        for node in nodes:
            node.visible = event.target.value

    gui.add_checkbox(label, initial_value=at_first).on_update(show)
