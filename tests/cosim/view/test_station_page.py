"""The page of the control station in a browser."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from tests.support.cosim.view_pages import (
    RECORDED,
    TOKEN,
    StationPage,
    browser,
    moving_state,
    open_station,
    picture,
    positions,
    positions_at,
    scan,
    scenery,
    states,
)
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, Mosaic, States
from vcmvsp.cosim.view.messages import Floor, Seek
from vcmvsp.cosim.view.page.cameras import in_picture
from vcmvsp.cosim.view.page.drawing import colors_of, rotated

pytestmark = [pytest.mark.processes, pytest.mark.sockets, pytest.mark.browser]

PATIENCE_S = 120.0  # for a browser without a graphics card, on a busy machine

# The page draws fewer pixels while the machine is busy, unless its URL names a resolution after removal of the token.
AT_FULL_RESOLUTION = """
    const replace = history.replaceState.bind(history);
    history.replaceState = (state, unused, url) => replace(state, unused, url === "/" ? "/?fixedDpr=1" : url);
"""


class Page:
    """A station, and a browser with its page open."""

    def __init__(self, station_page: StationPage, opened: Any, script: str = AT_FULL_RESOLUTION) -> None:
        self.station_page, self.page = station_page, opened
        self.problems: list[str] = []
        self.requests: list[str] = []
        opened.on("console", lambda message: self.problems.append(message.text) if message.type == "error" else None)
        opened.on("pageerror", lambda error: self.problems.append(str(error)))
        opened.on("request", lambda request: self.requests.append(request.url))
        opened.add_init_script(script)
        opened.goto(f"{station_page.url}/?token={TOKEN}")
        opened.wait_for_function(
            "window.__viserSceneTree?.getState()['/vehicles/ground'] !== undefined", timeout=PATIENCE_S * 1e3
        )
        self.until(lambda: bool(station_page.server.get_clients()))

    def show(self, time_s: float, **more: Any) -> None:
        """Show the scene at ``time_s`` to all clients."""
        self.station_page.now_s += 1.0
        self.station_page.station.show(moving_state(self.station_page.scene, time_s, **more))

    @property
    def camera(self) -> Any:
        """The camera of the page, which may have reconnected."""
        (client,) = self.station_page.server.get_clients().values()
        return client.camera

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
        """Wait until ``holds`` returns true."""
        end_s = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end_s
            self.page.wait_for_timeout(50)

    def places(self) -> Array:
        """Positions of the robots on the page."""
        return positions(self.page, "/vehicles/ground")

    @property
    def canvas(self) -> Any:
        """The part of the page with the scene: x, y, width and height in pixels."""
        return self.page.locator("canvas").first.bounding_box()

    def shows_positions_at(self, time_s: float) -> bool:
        """Whether the robots on the page have their positions at a time."""
        return np.allclose(self.places(), positions_at(self.station_page.scene, time_s), atol=1e-4)

    def redness(self) -> list[int]:
        """Red less blue near the middle of the scene: in the south-west, south-east, north-west and north-east."""
        box, colors = self.canvas, []
        for right, up in ((-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1), (0.1, 0.1)):
            across = (box["x"] + (0.5 + right) * box["width"]) / 1000
            colors.append(self.pixel(across, (box["y"] + (0.5 - up) * box["height"]) / 700))
        return [red - blue for red, _, blue in colors]

    def pixel(self, right: float, down: float) -> list[int]:
        """The colour of the page at ``right`` and ``down``, each from 0 to 1."""
        screenshot = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert screenshot is not None
        height, width = screenshot.shape[:2]
        return [int(part) for part in screenshot[int(down * height), int(right * width), ::-1]]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as started:
        yield started


@pytest.fixture(scope="module")
def page(chromium: Any) -> Iterator[Page]:
    with open_station(scenery(5)) as station_page:
        station_page.show(0.0)
        opened = chromium.new_page(viewport={"width": 1000, "height": 700})
        yield Page(station_page, opened)
        opened.close()


def at_rest(places: list[tuple[float, float, float]]) -> States:
    """The five vehicles of the page at rest, heading east."""
    return states(places, [0.0] * 5, ("v1", "v2", "v3", "v4", "v5"))


def look_down(page: Page, x: float, y: float, height: float) -> None:
    (client,) = page.station_page.server.get_clients().values()
    with client.atomic():
        client.camera.position = (x, y - 0.02 * height, height)
        client.camera.look_at = (x, y, 0.0)


def test_vehicles_have_their_positions_and_move(page: Page) -> None:
    for time_s in (0.0, 4.0):
        page.show(time_s)
        page.until(lambda time_s=time_s: page.shows_positions_at(time_s))  # type: ignore[misc]
    names = page.page.evaluate("Object.keys(window.__viserSceneTree.getState()).filter(name => name.startsWith('/names/'))")
    assert sorted(names) == [f"/names/v{index}" for index in range(1, 6)]


def test_texts_are_shown(page: Page) -> None:
    page.show(5.0)
    page.page.get_by_text("5.00 s", exact=True).first.wait_for(timeout=PATIENCE_S * 1e3)
    page.page.get_by_text("circle, every 0.1 s").wait_for(timeout=PATIENCE_S * 1e3)


def test_a_click_at_a_vehicle_chooses_it(page: Page) -> None:
    page.show(7.0)
    x, y, _ = positions_at(page.station_page.scene, 7.0)[3].tolist()
    look_down(page, x, y, 3.0)
    canvas = page.canvas

    def clicked() -> bool:
        page.page.mouse.click(canvas["x"] + 0.5 * canvas["width"], canvas["y"] + 0.5 * canvas["height"])
        page.page.wait_for_timeout(300)
        return bool(page.station_page.part("Vehicle").value == "v4")

    page.until(clicked)
    page.station_page.use("Vehicle", "v1")


def test_row_0_of_a_mosaic_is_its_south_edge(page: Page) -> None:
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[:] = (20, 20, 220)
    pixels[0, 0] = (220, 20, 20)
    page.station_page.use("On the floor", "mosaic")
    mosaic = Mosaic(left=10.0, bottom=10.0, cell_m=5.0, pixels=pixels)
    scene = page.station_page.scene
    page.station_page.station.show(moving_state(scene, 8.0))
    look_down(page, 15.0, 15.0, 12.0)
    page.show(8.1, mosaics={"v1": mosaic})
    page.until(lambda: sum(each < -50 for each in page.redness()) == 3)  # in view: nothing else is blue
    assert [each > 0 for each in page.redness()] == [True, False, False, False]


def test_a_choice_is_shown_during_a_pause(page: Page) -> None:
    page.station_page.now_s += 1.0
    page.station_page.use("Vehicle", "v2")
    page.page.get_by_text("follow, every 0.1 s").wait_for(timeout=PATIENCE_S * 1e3)
    page.station_page.use("Vehicle", "v1")


def test_the_camera_follows(page: Page) -> None:
    page.station_page.use("Camera follows")
    for time_s in (9.0, 12.0):
        place, before = positions_at(page.station_page.scene, time_s)[0], page.camera._state

        def follows(time_s: float = time_s, place: Array = place, before: Any = before) -> bool:
            page.show(time_s)
            state = page.camera._state
            return state is not before and np.allclose(state.look_at, place, atol=0.02)

        page.until(follows)  # and the page has reported its camera
        assert np.linalg.norm(page.camera.position - place) < 13.0
    page.station_page.use("Camera follows", False)


def test_fit_all_shows_all_vehicles_at_any_distance(page: Page) -> None:
    far = at_rest([(400.0 * (index + 1), 250.0 * (index % 2), 0.0) for index in range(5)])
    page.station_page.use("Names", False)
    page.station_page.use("Links", "none")
    page.show(20.0, states=far, places={}, links=())
    page.station_page.use("Fit all")
    page.until(lambda: bool(np.linalg.norm(page.camera.position - page.camera.look_at) > 500.0))

    def seen() -> bool:
        page.show(20.0, states=far, places={}, links=())
        page.page.wait_for_timeout(1000)
        taken = cv2.imdecode(np.frombuffer(page.page.screenshot(clip=page.canvas), np.uint8), cv2.IMREAD_COLOR)
        assert taken is not None
        widths = []
        for place, color in zip(far.position, colors_of(5), strict=True):
            column, row = pixel_of(place, page.camera, taken.shape)
            near = taken[row - 16 : row + 16, column - 16 : column + 16, ::-1].astype(int)
            same = np.abs(near - color.astype(int)).max(axis=2) < 40
            widths += [same.any(axis=0).sum(), same.any(axis=1).sum()]
        return min(widths) >= 12  # pixels, of about 13

    page.until(seen)
    page.station_page.use("Names", True)
    page.station_page.use("Links", "all")


def pixel_of(place: Array, camera: Any, shape: tuple[int, ...]) -> tuple[int, int]:
    """Column and row of a place in a picture of a camera; camera axes: x right, y down, z ahead."""
    w, *axis = camera.wxyz
    x, y, z = rotated(np.array([[w, *(-np.array(axis))]]), (place - camera.position)[None])[0]
    focal = 0.5 * shape[0] / np.tan(0.5 * camera.fov)
    return round(0.5 * shape[1] + focal * x / z), round(0.5 * shape[0] + focal * y / z)


def test_a_wall_before_a_vehicle_is_translucent(page: Page) -> None:
    behind = at_rest([(0.3 * index, 4.0, 0.0) for index in range(5)])

    def visible_from(position: tuple[float, float, float]) -> set[str]:
        page.camera.position, page.camera.look_at = position, (0.0, 4.0, 0.1)
        page.show(21.0, states=behind, places={})
        return {node for node in ("/veils/0", "/world/0") if page.station_page.node(node).visible}

    page.until(lambda: visible_from((0.0, 9.0, 0.6)) == {"/veils/0"})
    page.until(lambda: visible_from((0.0, -9.0, 3.0)) == {"/world/0"})


def test_the_team_stays_in_the_picture(page: Page) -> None:
    page.station_page.use("Follow team")

    def centred(east: float) -> bool:
        page.show(22.0, states=at_rest([(east + index, 1.0, 0.0) for index in range(5)]), places={})
        return bool(np.allclose(page.camera.look_at, (east + 2.0, 1.0, 0.0), atol=0.1))

    for east in (10.0, 30.0):
        page.until(lambda east=east: centred(east))  # type: ignore[misc]
    page.station_page.use("Follow team", False)


def test_every_vehicle_stays_in_the_picture_until_the_camera_is_moved(chromium: Any) -> None:
    with open_station(scenery(2)) as station_page:
        page = Page(station_page, chromium.new_page(viewport={"width": 1000, "height": 700}))

        def is_shown_at(east: float) -> bool:
            vehicle_states = states([(0.0, 0.0, 0.0), (east, 0.0, 0.0)], [0.0, 0.0], ("v1", "v2"))
            page.show(1.0, states=vehicle_states, places={}, links=())
            return in_picture(vehicle_states.position, page.camera)

        page.until(lambda: is_shown_at(1.0))
        assert not in_picture(np.array([(30.0, 0.0, 0.0)]), page.camera)
        page.until(lambda: is_shown_at(30.0))
        wide = page.camera.position
        assert is_shown_at(2.0)
        assert page.camera.position.tolist() == wide.tolist()  # and shows what it showed
        page.camera.position = moved = wide + 3.0
        assert not any(is_shown_at(200.0) for _ in range(3))
        assert page.camera.position.tolist() == moved.tolist()
        station_page.use("Fit all")
        page.until(lambda: is_shown_at(400.0))
        page.page.close()


def test_the_picture_of_the_floor_has_north_above_and_hides_the_plain_floor(chromium: Any) -> None:
    pixels = np.full((20, 20, 3), (200, 40, 40), np.uint8)
    pixels[:10, 10:] = (40, 40, 200)  # in the north-east
    floor = Floor(pixels=pixels, center=(30.0, 30.0), size=(40.0, 40.0))
    with open_station(scenery(1, floor=floor)) as station_page:
        station_page.show(0.0)
        page = Page(station_page, chromium.new_page(viewport={"width": 1000, "height": 700}))
        look_down(page, 30.0, 30.0, 60.0)
        page.until(lambda: [each > 50 for each in page.redness()] == [True, True, True, False])
        page.until(lambda: page.redness()[3] < -50)
        page.page.close()


@pytest.fixture(scope="class")
def recording(chromium: Any) -> Iterator[Page]:
    """A page that was opened during a pause at 20 s, of a vehicle and two events."""
    with open_station(scenery(1, may=RECORDED, events_ns=(4 * SECOND_NS, 40 * SECOND_NS))) as station_page:
        station_page.show(0.0)
        station_page.now_s += 1.0
        station_page.station.show(moving_state(station_page.scene, 20.0))  # no client: nothing is sent
        opened = chromium.new_page(viewport={"width": 1000, "height": 700})
        yield Page(station_page, opened)
        opened.close()


class TestRecording:
    """Tests of one page, which closes after them: a page that is open takes time of all others."""

    def test_a_page_opened_during_a_pause_shows_the_present_state(self, recording: Page) -> None:
        recording.until(lambda: recording.shows_positions_at(20.0))

    def test_a_shadow_is_darker_than_the_floor_on_the_sunny_side_of_its_wall(self, recording: Page) -> None:
        look_down(recording, 0.3, 6.1, 4.0)  # at a wall 1 m high at y = 6 m; the sun is in the south-east

        def light(y: float) -> int:
            right, down = pixel_of(np.array((0.3, y, 0.0)), recording.camera, (700, 1000))
            return sum(recording.pixel(right / 1000, down / 700))

        recording.until(lambda: light(6.55) < 0.8 * light(5.3))

    def test_the_slider_of_a_recording_has_marks_and_goes_to_the_next_event(self, recording: Page) -> None:
        recording.until(lambda: recording.page.locator(".mantine-Slider-mark").count() == 2)
        recording.page.get_by_role("button", name="next").click()
        recording.until(lambda: Seek(time_ns=40 * SECOND_NS) in recording.station_page.orders)


def test_the_page_has_all_objects_of_the_scene_and_events_and_charts(page: Page) -> None:
    for box in ("ring (ring)", "down (nadir_camera)"):
        page.station_page.use(box)
    for time_s in (30.0, 31.0):
        page.show(time_s, scans={"v1/ring": scan()}, images={"v1/down": picture((200, 0, 0))})
    nodes = {"/floor-picture", "/axes/east", "/axes/north", "/axes/up", "/links", "/trails", "/places/marks", "/places/leaders"}
    nodes |= {"/scans/v1/ring", "/fans/v1/ring", "/cameras/v1/down", "/obstacles/crate", "/targets/red"}

    def missing() -> set[str]:
        return {name for name in nodes if not page.page.evaluate(f"'{name}' in window.__viserSceneTree.getState()")}

    page.until(lambda: not missing())
    legend = page.page.get_by_text("Frames, sender")
    legend.wait_for()
    assert all(words in legend.inner_text() for words in ("slot of a follower", "to its leader", "chosen vehicle"))
    page.page.get_by_role("tab", name="Charts").click()
    page.page.get_by_text("Formation error [m]").first.wait_for(timeout=PATIENCE_S * 1e3)
    page.page.get_by_role("tab", name="All vehicles").click()
    page.page.get_by_text("message [s ago]").wait_for(timeout=PATIENCE_S * 1e3)
    page.page.get_by_role("tab", name="Vehicle", exact=True).click()


def test_the_token_stays_in_its_tab_and_with_its_port(page: Page, chromium: Any) -> None:
    opened = Page(page.station_page, chromium.new_page(), script="").page
    assert opened.url == f"{page.station_page.url}/"
    assert opened.context.cookies() == []
    assert opened.evaluate("sessionStorage.getItem('token')") == TOKEN
    opened.close()
    stranger = chromium.new_page()
    stranger.goto(page.station_page.url)
    stranger.get_by_text("Open the printed URL, including its token.").wait_for(timeout=PATIENCE_S * 1e3)
    stranger.close()


def test_an_inserted_script_does_not_run(page: Page) -> None:
    violations = """() => new Promise(resolve => {
        document.addEventListener("securitypolicyviolation", event => resolve(event.effectiveDirective), { once: true });
        document.body.insertAdjacentHTML("beforeend", "<img src='data:,' onerror='window.canary = 1'>");
    })"""
    assert page.page.evaluate(violations) == "script-src-attr"
    assert page.page.evaluate("window.canary") is None
    page.problems.clear()


def test_a_reloaded_page_is_shown_again(page: Page) -> None:
    page.page.reload()
    page.page.get_by_text("circle, every 0.1 s").wait_for(timeout=PATIENCE_S * 1e3)
    page.problems.clear()  # the browser reports the URL without its token


def test_there_are_no_foreign_requests_and_no_errors(page: Page) -> None:
    own = page.station_page.url
    foreign = [url for url in page.requests if not url.startswith((own, "data:", f"blob:{own}", own.replace("http", "ws")))]
    assert foreign == []
    assert page.problems == []
    assert any(url.startswith(own) for url in page.requests)
