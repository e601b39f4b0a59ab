"""Calls the services of a run with zenoh-ros2-sdk, while a `ros2_node.Driver` of the same process answers its observations.

Definitions of the package ``simulation_interfaces`` 2.1.0, without comments and constants. As a program, ``PORT``: it pauses
the run before its first instant, makes the calls of `script`, lets the run end, and prints a JSON list of the responses: the
name of each call, and its fields.
"""

import json
import os
import queue
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2ServiceClient
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.utils import compute_service_type_hash

from tests.support.hardware.ros2_node import Driver

OWN = "simulation_interfaces/"
MESSAGES = {
    "Result": "uint8 result\nstring error_message\n",
    "SimulationState": "uint8 state\n",
    "SimulatorFeatures": "uint16[] features\nstring[] spawn_formats\nstring custom_info\n",
    "EntityCategory": "uint8 category\n",
    "TagsFilter": "string[] tags\nuint8 filter_mode\n",
    "Bounds": "uint8 type\ngeometry_msgs/Vector3[] points\n",
    "EntityFilters": "string filter\nEntityCategory[] categories\nTagsFilter tags\nBounds bounds\n",
    "EntityState": "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    "geometry_msgs/Twist twist\ngeometry_msgs/Accel acceleration\n",
}
SERVICES = {
    "GetSimulatorFeatures": ("# nothing\n", "SimulatorFeatures features\n"),
    "GetSimulationState": ("# nothing\n", "SimulationState state\nResult result\n"),
    "SetSimulationState": ("SimulationState state\n", "Result result\n"),
    "StepSimulation": ("uint64 steps 1\n", "Result result\n"),
    "ResetSimulation": ("uint8 scope\n", "Result result\n"),
    "GetEntities": ("EntityFilters filters\n", "Result result\nstring[] entities\n"),
    "GetEntityState": ("string entity\n", "Result result\nEntityState state\n"),
    "GetEntitiesStates": ("EntityFilters filters\n", "Result result\nstring[] entities\nEntityState[] states\n"),
    "SetEntityState": (
        "string entity\nEntityState state\nbool set_pose\nbool set_twist\nbool set_acceleration\n",
        "Result result\n",
    ),
}
PATIENCE_S = 60.0


def with_packages(definition: str) -> str:
    """The definition with the package of each type."""
    for name in MESSAGES:
        definition = "".join(
            f"{OWN}{line}\n" if line.startswith((f"{name} ", f"{name}[")) else f"{line}\n" for line in definition.splitlines()
        )
    return definition


STORE = get_typestore(Stores.ROS2_JAZZY)
for message, text in MESSAGES.items():
    STORE.register(get_types_from_msg(with_packages(text), f"{OWN}msg/{message}"))


def dependencies() -> dict[str, str]:
    """Text of all nested types."""
    common = [
        "builtin_interfaces/msg/Time",
        *(f"geometry_msgs/msg/{name}" for name in ("Pose", "Point", "Quaternion", "Twist", "Accel", "Vector3")),
    ]
    texts = {name: STORE.generate_msgdef(name)[0].partition("=" * 10)[0] for name in common}
    texts["std_msgs/msg/Header"] = "builtin_interfaces/Time stamp\nstring frame_id\n"  # rosbags writes that of ROS 1
    return texts | {f"{OWN}msg/{name}": with_packages(text) for name, text in MESSAGES.items()}


def hash_of(kind: str) -> str:
    """Hash of a service's type, by the SDK."""
    request, response = map(with_packages, SERVICES[kind])
    return compute_service_type_hash(f"{OWN}srv/{kind}", request, response, dependencies())


def snake(kind: str) -> str:
    """``GetEntities`` as ``get_entities``."""
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in kind).lstrip("_")


class Caller:
    """Clients of all services."""

    def __init__(self, port: int) -> None:
        self.clients: dict[str, ROS2ServiceClient] = {}
        for kind, (request, response) in SERVICES.items():
            if not self.clients:
                self._register(port)
            self.clients[kind] = self._client(kind, request, response, port)
        self.session = next(iter(self.clients.values())).session_mgr

    def _register(self, port: int) -> None:
        session = ZenohSession.get_instance("127.0.0.1", port)
        for name, text in dependencies().items():
            if name not in session.store.types:
                session.register_message_type(text, name)

    def _client(self, kind: str, request: str, response: str, port: int) -> ROS2ServiceClient:
        return ROS2ServiceClient(
            f"/{snake(kind)}",
            f"{OWN}srv/{kind}",
            request_definition=with_packages(request),
            response_definition=with_packages(response),
            router_port=port,
            type_hash=hash_of(kind),
            timeout=PATIENCE_S,
        )

    def await_service(self, kind: str) -> None:
        """Wait until the run offers a service: its token."""
        while not self._is_offered(kind):
            time.sleep(0.01)

    def _is_offered(self, kind: str) -> bool:
        replies = self.session.liveliness.get("@ros2_lv/0/**", timeout=5.0)
        tokens = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        own = f"simulation_interfaces::srv::dds_::{kind}_"
        return any(
            each[5] == "SS" and each[9:12] == [f"%{snake(kind)}", own, hash_of(kind)] for each in tokens if len(each) == 13
        )

    def make(self, name: str, **fields: Any) -> Any:
        """A message of the SDK's store."""
        return self.session.store.types[name](**fields)


def plain(value: Any) -> Any:
    """A message as dictionaries and lists."""
    if hasattr(value, "__msgtype__"):
        return {name: plain(each) for name, each in vars(value).items() if name != "__msgtype__"}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return value.tolist() if hasattr(value, "tolist") else value


def script(caller: Caller) -> Iterator[tuple[str, dict[str, Any]]]:
    """Calls to a paused run."""

    def state(number: int) -> dict[str, Any]:
        return {"state": caller.make(f"{OWN}msg/SimulationState", state=number)}

    def filters(text: str, *, categories: tuple[int, ...] = (), bounds: int = 0) -> dict[str, Any]:
        kinds = [caller.make(f"{OWN}msg/EntityCategory", category=each) for each in categories]
        tags = caller.make(f"{OWN}msg/TagsFilter", tags=[], filter_mode=0)
        box = caller.make(f"{OWN}msg/Bounds", type=bounds, points=[])
        whole = caller.make(f"{OWN}msg/EntityFilters", filter=text, categories=kinds, tags=tags, bounds=box)
        return {"filters": whole}

    def put(
        entity: str, x: float, y: float, turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0), vx: float | None = None
    ) -> dict[str, Any]:
        vector = {
            name: caller.make("geometry_msgs/msg/Vector3", x=speed, y=0.0, z=0.0)
            for name, speed in (("v", vx or 0.0), ("0", 0.0))
        }
        w, qx, qy, qz = turn
        place = caller.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        pose = caller.make(
            "geometry_msgs/msg/Pose",
            position=place,
            orientation=caller.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=w),
        )
        stamp = caller.make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        whole = caller.make(
            f"{OWN}msg/EntityState",
            header=caller.make("std_msgs/msg/Header", stamp=stamp, frame_id="map"),
            pose=pose,
            twist=caller.make("geometry_msgs/msg/Twist", linear=vector["v"], angular=vector["0"]),
            acceleration=caller.make("geometry_msgs/msg/Accel", linear=vector["0"], angular=vector["0"]),
        )
        return {"entity": entity, "state": whole, "set_pose": True, "set_twist": vx is not None, "set_acceleration": False}

    yield "GetSimulatorFeatures", {}
    yield "GetSimulationState", {}
    yield "SetSimulationState", state(2)  # it is paused already
    yield "SetSimulationState", state(0)  # a run cannot be restarted
    yield "ResetSimulation", {"scope": 0}
    for each in (filters(""), filters("car."), filters("("), filters("", categories=(1,)), filters("", bounds=3)):
        yield "GetEntities", each
    yield "GetEntityState", {"entity": "car9"}
    yield "GetEntityState", {"entity": "car1"}
    yield "StepSimulation", {"steps": 1}
    yield "GetEntityState", {"entity": "car1"}
    yield "StepSimulation", {"steps": 10}
    yield "GetEntityState", {"entity": "car1"}
    yield "StepSimulation", {"steps": 0}
    yield "SetEntityState", put("crate", 4.0, 2.0, (0.0, 0.0, 0.0, 1.0))
    yield "StepSimulation", {"steps": 2}  # it is moved at the next instant, and observed there at the one after it
    yield "GetEntitiesStates", filters("c.*")
    yield "SetEntityState", put("car1", 4.0, 2.0)
    yield "SetEntityState", put("car9", 4.0, 2.0)
    yield "SetEntityState", put("crate", 4.0, 3.0, (2.0, 0.0, 0.0, 0.0))
    yield "SetEntityState", put("crate", 4.0, 3.0, (0.0, 1.0, 0.0, 0.0))
    yield "SetEntityState", put("crate", 4.0, 3.0, vx=1.0)
    yield "SetEntityState", put("crate", 6.0, 0.0)  # in the wall
    if "--quit" in sys.argv:
        yield "SetSimulationState", state(3)
    else:
        yield "SetSimulationState", state(1)


def main(port: int) -> None:
    """The calls, and the end of the run."""
    caller, paused = Caller(port), queue.SimpleQueue[Any]()
    caller.await_service("SetSimulationState")
    request = {"state": caller.make(f"{OWN}msg/SimulationState", state=2)}
    caller.clients["SetSimulationState"].call_async(paused.put, **request)
    driver = Driver(port, "car1", 2.0, 1.0)  # the run begins with a call that waits
    replies = [("SetSimulationState", plain(paused.get(timeout=PATIENCE_S)))]
    call: Callable[..., Any]
    for kind, fields in script(caller):
        call = caller.clients[kind].call
        replies.append((kind, plain(call(**fields))))
    sys.stdout.write(json.dumps(replies) + "\n")
    sys.stdout.flush()
    sys.stdin.read()
    del driver
    os._exit(0)  # the SDK's session does not end


if __name__ == "__main__":
    main(int(sys.argv[1]))
