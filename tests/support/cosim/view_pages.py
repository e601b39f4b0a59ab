"""A station page without a run: a scenery, states in it, and a browser."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
import viser
import zstandard
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

from tests.support import requirements
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Array, Follows, Image, Scan, States
from vcmvsp.cosim.view.messages import Craft, Lens, LinkStatus, Obstacle, Order, Pace, PageUpdate, Scenery
from vcmvsp.cosim.view.page.control_station import Station
from vcmvsp.cosim.view.page.state import PageState
from vcmvsp.cosim.view.web_server import close_server, open_server

T = TypeVar("T")
TOKEN = "a-secret-of-this-test"
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
VERSION = Subprotocol(f"viser-v{viser.__version__}")
PATIENCE_S = 30.0
LIVE = ("sensors", "pace", "halt", "outage", "move", "set", "end")
RECORDED = ("sensors", "pace", "seek")


DOWN = Lens(
    mount=(0.1, 0.0, 0.0),
    body_from_camera=((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    field_of_view=0.8,
    aspect=4 / 3,
)
"""A camera that looks down, with the upper edge of its picture ahead."""


def scenery(count: int = 3, flying: int = 0, may: tuple[str, ...] = LIVE, **more: Any) -> Scenery:
    """``count`` vehicles before a wall, the last ``flying`` of them in the air, with a movable crate."""
    crafts = [
        Craft(
            name=f"v{index + 1}",
            kind="quadrotor" if index >= count - flying else "p2dx",
            size=(0.5, 0.5, 0.2) if index >= count - flying else (0.5, 0.4, 0.22),
            flies=index >= count - flying,
            agent="circle" if index == 0 else "follow",
            period_s=0.1,
            sensors={"ring": "ring", "down": "nadir_camera"},
            cameras={"down": DOWN},
        )
        for index in range(count)
    ]
    vertices = np.array([(x, 6.0 + y, z) for z in (0.0, 1.0) for x, y in ((-3, 0), (3, 0), (3, 0.2), (-3, 0.2))], np.float32)
    triangles = np.array([(0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5), (4, 5, 6), (4, 6, 7)], np.uint32)
    content: dict[str, Any] = {
        "scenario": "synthetic",
        "seed": 7,
        "duration_ns": 60 * SECOND_NS,
        "vehicles": tuple(crafts),
        "vertices": vertices,
        "triangles": triangles,
        "colors": np.tile(np.array((180, 120, 90), np.uint8), (len(triangles), 1)),
        "obstacles": (
            Obstacle(
                name="crate",
                shape="box",
                size=(0.6, 0.6, 0.6),
                pose=(4.0, 0.0, 0.3, 0.2),
                color=(120, 90, 60),
                may_be_moved=True,
            ),
        ),
        "targets": (("red", -3.0, 2.0),),
        "live": "seek" not in may,
        "may": may,
        "keys": {"radio.loss.probability": 0.2} if "set" in may else {},
    }
    return Scenery(**{**content, **more})


def states(positions: list[tuple[float, float, float]], yaws: list[float], names: tuple[str, ...]) -> States:
    """States of vehicles at rest: positions, m, and headings, rad."""
    zero = np.zeros((len(names), 3))
    attitude = np.array([quaternion_from_yaw(yaw) for yaw in yaws])
    return States(names=names, position=np.array(positions), velocity=zero, attitude=attitude, angular_velocity=zero)


def moving_state(scene: Scenery, time_s: float, **more: Any) -> PageUpdate:
    """All vehicles circle, the first one leads; every frame is received but those of the last vehicle."""
    names = tuple(each.name for each in scene.vehicles)
    count = len(names)
    angle = 0.3 * time_s + math.tau * np.arange(count) / max(count, 1)
    radius = max(2.0, 0.25 * count)
    height = np.array([3.0 if each.flies else 0.11 for each in scene.vehicles])
    yaw = angle + 0.5 * math.pi
    zero = np.zeros(count)
    position = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    velocity = 0.3 * radius * np.column_stack([np.cos(yaw), np.sin(yaw), zero])
    attitude = np.column_stack([np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)])
    sent = np.full((count, count), 1 + int(10 * time_s))
    received = sent.copy()
    received[-1:] //= 2
    content: dict[str, Any] = {
        "states": States(
            names=names, position=position, velocity=velocity, attitude=attitude, angular_velocity=np.zeros((count, 3))
        ),
        "places": {name: Follows(leader=names[0], slot=(-1.5, (-1.0) ** index)) for index, name in enumerate(names[1:3])},
        "notes": {name: {"mode": "formation", "error": 0.1} for name in names[1:2]},
        "links": tuple(link(names, index, time_s) for index in range(min(count, 10))),
        "sent": sent,
        "received": received,
        "heard_ns": {name: int(time_s * SECOND_NS) for name in names},
        "pace": Pace(speed=1.0, achieved=0.98) if scene.live else Pace(speed=1.0),
        "lines": (LogLine(time_ns=0, level="info", text="it begins"),) if time_s == 0.0 else (),
    }
    return PageUpdate(time_ns=int(time_s * SECOND_NS), **{**content, **more})


def positions_at(scene: Scenery, time_s: float) -> Array:
    """Positions of all vehicles in `moving_state`, (n, 3) m."""
    vehicle_states = moving_state(scene, time_s).states
    assert vehicle_states is not None
    return vehicle_states.position


def link(names: tuple[str, ...], sender: int, time_s: float) -> LinkStatus:
    """A frame to all others."""
    others = tuple(name for name in names if name != names[sender])
    lost = sender == len(names) - 1
    return LinkStatus(
        sender=names[sender],
        sent_ns=int(time_s * SECOND_NS),
        receivers=others,
        rssi_dbm=np.linspace(-90.0, -45.0, len(others)),
        received=np.full(len(others), not lost),
        outcome=("random loss" if lost else "received",) * len(others),
    )


def picture(color: tuple[int, int, int], time_s: float = 0.0) -> Image:
    """A picture of one colour."""
    return Image(pixels=np.tile(np.array(color, np.uint8), (60, 80, 1)), time_ns=int(time_s * SECOND_NS), focal_px=70.0)


def scan(range_m: float = 1.0) -> Scan:
    """Four beams, one without a return."""
    return Scan(
        ranges=np.array([range_m, range_m, np.inf, range_m], np.float32), angle_min=0.0, angle_step=math.pi / 2, range_max=8.0
    )


def station_state(scene: Scenery, *messages: PageUpdate) -> PageState:
    """State of a station after these messages."""
    known = PageState(scene)
    for message in messages:
        known.take(message)
    return known


class StationPage:
    """A station on a server of its own, and its received orders."""

    def __init__(self, server: viser.ViserServer, scene: Scenery) -> None:
        self.server, self.scene = server, scene
        self.orders: list[Order] = []
        self.now_s = 0.0
        self.station = Station(server, scene, self.orders.append, clock=lambda: self.now_s)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def show(self, time_s: float, **more: Any) -> None:
        """Show a state, and draw it without an open page, a second of wall-clock time later."""
        self.now_s += 1.0
        self.station.show(moving_state(self.scene, time_s, **more))
        self.station.draw()

    def node(self, name: str) -> Any:
        """A node of the scene."""
        handle = self.server.scene.get_handle_by_name(name)
        assert handle is not None, name
        return handle

    def part(self, label: str) -> Any:
        """The element of the page with this label."""
        handles = self.server.gui._gui_input_handle_from_uuid.values()
        found = [each for each in handles if getattr(each, "label", None) == label]
        assert len(found) == 1, (label, [getattr(each, "label", None) for each in handles])
        return found[0]

    def has(self, label: str) -> bool:
        """Whether the page has an element with this label."""
        return any(getattr(each, "label", None) == label for each in self.server.gui._gui_input_handle_from_uuid.values())

    def use(self, label: str, value: Any = True) -> None:
        """Press a button, tick a box, or choose or write a value on the page."""
        part = self.part(label)
        part._impl.value = value
        for callback in part._impl.update_cb:
            callback(viser.GuiEvent(client=None, client_id=1, target=part))

    def parts(self, kind: type[T]) -> list[T]:
        """The elements of the page of this kind, from the top."""
        folders = list(self.server.gui._container_handle_from_uuid.values())
        return [part for folder in folders for part in folder._children.values() if isinstance(part, kind)]

    def looked_at(self, patch: pytest.MonkeyPatch) -> None:
        """Pretend that a page is open, which has not reported its camera yet."""
        page = SimpleNamespace(camera=SimpleNamespace(update_timestamp=0.0))
        patch.setattr(self.server, "get_clients", lambda: {1: page})

    def told(self, act: Callable[[], None]) -> list[Any]:
        """Messages to the pages after a state."""
        messages: list[Any] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self.server._websock_server, "queue_message", messages.append)
            act()
        return messages


@contextmanager
def open_station(scene: Scenery) -> Iterator[StationPage]:
    """A station; leaving the block closes its server."""
    server = open_server("127.0.0.1", 0, TOKEN)
    try:
        yield StationPage(server, scene)
    finally:
        close_server(server)


def page_connection(host: str, token: str, **changed: Any) -> Connection:
    """A connection like that of a page, to a host and port."""
    own: dict[str, Any] = {
        "origin": Origin(f"http://{host}"),
        "subprotocols": [VERSION, Subprotocol(f"token.{token}")],
        "compression": None,
        "max_size": None,
        "open_timeout": PATIENCE_S,
        "close_timeout": PATIENCE_S,
    }
    return connect(f"ws://{host}/", **own | changed)


def unpacked(message: str | bytes) -> bytes:
    """The content of messages from viser: msgpack."""
    assert isinstance(message, bytes)
    size = int.from_bytes(message[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(message[16 : 16 + size])


@contextmanager
def browser() -> Iterator[Any]:
    """A browser; without one the test is skipped."""
    from playwright.sync_api import sync_playwright

    chromium = requirements.program("chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        try:
            yield started
        finally:
            started.close()


def positions(page: Any, node: str) -> Array:
    """Where the page has the instances of a node, (n, 3) m."""
    numbers = page.evaluate(
        "name => { const b = window.__viserSceneTree.getState()[name].message.props.batched_positions;"
        " return Array.from(b instanceof Float32Array ? b : new Float32Array(b.buffer, b.byteOffset, b.byteLength / 4)) }",
        node,
    )
    return np.array(numbers).reshape(-1, 3)
