"""Services of the package ``simulation_interfaces`` (ROS 2): programs see the entities of a run, pause it, step it and end it.

Definitions of the version 2.1.0 (https://github.com/ros-simulation/simulation_interfaces). Entities are the vehicles and the
obstacles that can be pushed, with their true states in the frame ``map``. What changes the run is done as by an operator of
the control station: a moved obstacle is an intervention, which the recorded scenario lists.
"""

import math
import queue
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from vcmvsp.cosim.federate import RunControl
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording import ros_messages as ros
from vcmvsp.cosim.recording.ros_services import register_message, register_service
from vcmvsp.cosim.types import VehicleState
from vcmvsp.hardware.drivers.ros2.node import Call, Node
from vcmvsp.hardware.drivers.ros2.protocol import Endpoint

PACKAGE = "simulation_interfaces"
FRAMES = "", "map", "world"  # names of the one frame
MESSAGES = {  # each after those it has
    "Result": "uint8 result\nstring error_message",
    "SimulationState": "uint8 state",
    "SimulatorFeatures": "uint16[] features\nstring[] spawn_formats\nstring custom_info",
    "EntityCategory": "uint8 category",
    "TagsFilter": "string[] tags\nuint8 filter_mode",
    "Bounds": "uint8 type\ngeometry_msgs/Vector3[] points",
    "EntityFilters": f"string filter\n{PACKAGE}/EntityCategory[] categories\n"
    f"{PACKAGE}/TagsFilter tags\n{PACKAGE}/Bounds bounds",
    "EntityState": "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    "geometry_msgs/Twist twist\ngeometry_msgs/Accel acceleration",
}
_RESULT = f"{PACKAGE}/Result result"
_FILTERS = f"{PACKAGE}/EntityFilters filters"
SERVICES = {  # name of the service: its type, fields of the request, fields of the response
    "get_simulator_features": ("GetSimulatorFeatures", "", f"{PACKAGE}/SimulatorFeatures features"),
    "get_simulation_state": ("GetSimulationState", "", f"{PACKAGE}/SimulationState state\n{_RESULT}"),
    "set_simulation_state": ("SetSimulationState", f"{PACKAGE}/SimulationState state", _RESULT),
    "step_simulation": ("StepSimulation", "uint64 steps 1", _RESULT),
    "reset_simulation": ("ResetSimulation", "uint8 scope", _RESULT),
    "get_entities": ("GetEntities", _FILTERS, f"{_RESULT}\nstring[] entities"),
    "get_entity_state": ("GetEntityState", "string entity", f"{_RESULT}\n{PACKAGE}/EntityState state"),
    "get_entities_states": (
        "GetEntitiesStates",
        _FILTERS,
        f"{_RESULT}\nstring[] entities\n{PACKAGE}/EntityState[] states",
    ),
    "set_entity_state": (
        "SetEntityState",
        f"string entity\n{PACKAGE}/EntityState state\nbool set_pose\nbool set_twist\nbool set_acceleration",
        _RESULT,
    ),
}
UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)  # Result
ALREADY, INVALID_POSE = 101, 101  # of SetSimulationState, of SetEntityState
PLAYING, PAUSED, QUITTING = 1, 2, 3  # SimulationState
ENTITY_READ, ENTITY_WRITTEN, RUN_READ, RUN_WRITTEN = 10, 11, 24, 25  # SimulatorFeatures: access to states
PAUSE, STEP, STEPS = 26, 31, 32  # SimulatorFeatures
MOST_STEPS = 10**9
UNIT_WITHIN = 0.01  # of a quaternion's norm
UPRIGHT_WITHIN = 0.01  # rad, about
WAITING = 1000  # calls in the queue


class _RefusedCall(Exception):
    """A call that is not carried out, with its result."""

    def __init__(self, result: int, why: str) -> None:
        self.result = result
        super().__init__(why)


class SimulationServices:
    """The services of a node; calls wait until the run attends to them, in their order."""

    def __init__(self, node: Node) -> None:
        register()
        self._requests: queue.SimpleQueue[tuple[str, Call]] = queue.SimpleQueue()
        self._stepping: Call | None = None  # is answered when its steps are over
        self._answers: Mapping[str, Callable[[RunControl, Any], tuple[object, ...]]] = {
            "get_simulator_features": _features,
            "get_simulation_state": _state_of_run,
            "set_simulation_state": _set_state,
            "reset_simulation": _reset,
            "get_entities": _entities,
            "get_entity_state": _state_of_entity,
            "get_entities_states": _states,
            "set_entity_state": _place,
        }
        for name, (kind, _, _) in SERVICES.items():
            endpoint = Endpoint("SS", name, f"{PACKAGE}/srv/{kind}")
            node.add(endpoint)
            node.serve(endpoint, partial(self._hand_over, name))

    def _hand_over(self, service: str, call: Call) -> None:  # in Zenoh's thread
        if self._requests.qsize() < WAITING:
            self._requests.put((service, call))

    def attend(self, control: RunControl) -> None:
        """Answer the calls; while a step is not over, the others wait."""
        if self._stepping is not None:
            if not control.held:
                return
            self._conclude(self._stepping, OK, "")
        while self._stepping is None and not self._requests.empty():
            self._carry_out(control, *self._requests.get())

    def close(self) -> None:
        """Answer a step that the end of the run has cut."""
        if self._stepping is not None:
            self._conclude(self._stepping, FAILED, "the run has ended")

    def _carry_out(self, control: RunControl, service: str, call: Call) -> None:
        kind, fields, _ = SERVICES[service]
        request: Any = None
        try:
            request = ros.decoded(call.data, f"{PACKAGE}/srv/{kind}_Request") if fields else None
            if service == "step_simulation":
                self._step(control, request.steps, call)
                return
            response = self._answers[service](control, request)
        except _RefusedCall as refused:
            response = failed(service, refused.result, str(refused))
        except ValueError as error:
            response = failed(service, FAILED, str(error))
        call.reply(encoded(service, response))
        if service == "set_simulation_state" and request is not None and request.state.state == QUITTING:
            control.end()

    def _step(self, control: RunControl, steps: int, call: Call) -> None:
        _check_pause(control)
        if not control.paused:
            raise _RefusedCall(FAILED, "the run is not paused")
        if not 1 <= steps <= MOST_STEPS:
            raise _RefusedCall(FAILED, f"steps must be from 1 to {MOST_STEPS}")
        self._stepping = call
        control.go(paused=True, steps=steps)

    def _conclude(self, call: Call, result: int, why: str) -> None:
        self._stepping = None
        call.reply(encoded("step_simulation", (_result(result, why),)))


def register() -> None:
    """Add the definitions to the store of messages."""
    for name, fields in MESSAGES.items():
        register_message(f"{PACKAGE}/msg/{name}", fields)
    for kind, request, response in SERVICES.values():
        register_service(f"{PACKAGE}/srv/{kind}", request, response)


def _message(name: str, *fields: object) -> ros.RosMessage:
    return ros.make(f"{PACKAGE}/{name}", *fields)


def _result(result: int = OK, why: str = "") -> ros.RosMessage:
    return _message("Result", result, why)


def encoded(service: str, fields: tuple[object, ...]) -> bytes:
    """CDR bytes of the response with these fields."""
    kind: Callable[..., ros.RosMessage] = ros.store().types[f"{PACKAGE}/srv/{SERVICES[service][0]}_Response"]
    return ros.encoded(kind(*fields))


def failed(service: str, result: int, why: str) -> tuple[object, ...]:
    """Response without content."""
    status = _result(result, why)
    empty: Mapping[str, tuple[object, ...]] = {
        "get_entities": (status, []),
        "get_entities_states": (status, [], []),
        "get_entity_state": (status, _entity_state(0, VehicleState(position=(0.0, 0.0, 0.0)))),
    }
    return empty.get(service, (status,))


# --- the run -----------------------------------------------------------------------------------------------------------------


def _check_pause(control: RunControl) -> None:
    if not control.may_pause:
        raise _RefusedCall(UNSUPPORTED, "robots, programs or other stacks take part in the run, which cannot wait")


def _features(control: RunControl, _: None) -> tuple[object, ...]:
    features = [ENTITY_READ, RUN_READ, RUN_WRITTEN]
    if control.obstacles:
        features.append(ENTITY_WRITTEN)
    if control.may_pause:
        features += [PAUSE, STEP, STEPS]
    about = f"VCMVSP; a step is {control.step_s:g} s"
    return (_message("SimulatorFeatures", np.array(sorted(features), np.uint16), [], about),)


def _state_of_run(control: RunControl, _: None) -> tuple[object, ...]:
    return _message("SimulationState", PAUSED if control.paused else PLAYING), _result()


def _set_state(control: RunControl, request: Any) -> tuple[object, ...]:
    state = request.state.state
    if state == QUITTING:
        return (_result(),)
    if state not in (PLAYING, PAUSED):
        raise _RefusedCall(UNSUPPORTED, "a run can play, pause and quit; to start again, start another run")
    if control.paused == (state == PAUSED):
        raise _RefusedCall(ALREADY, "it is in this state")
    _check_pause(control)
    control.go(paused=state == PAUSED)
    return (_result(),)


def _reset(_control: RunControl, _: Any) -> tuple[object, ...]:
    raise _RefusedCall(UNSUPPORTED, "a run cannot be reset; start another run")


# --- entities ----------------------------------------------------------------------------------------------------------------


def _selected(control: RunControl, filters: Any) -> dict[str, tuple[int, VehicleState]]:
    """Entities whose whole names match the regular expression, in their order."""
    if len(filters.categories) or len(filters.tags.tags) or filters.bounds.type:
        raise _RefusedCall(UNSUPPORTED, "entities can be selected by their names only")
    try:
        pattern = re.compile(filters.filter or ".*", re.DOTALL)
    except re.error as error:
        raise _RefusedCall(FAILED, f"'{filters.filter}' is not a regular expression: {error}") from None
    return {name: truth for name, truth in control.truths().items() if pattern.fullmatch(name)}


def _entities(control: RunControl, request: Any) -> tuple[object, ...]:
    return _result(), list(_selected(control, request.filters))


def _states(control: RunControl, request: Any) -> tuple[object, ...]:
    entities = _selected(control, request.filters)
    return _result(), list(entities), [_entity_state(*truth) for truth in entities.values()]


def _row_and_state(control: RunControl, name: str) -> tuple[int, VehicleState]:
    truths = control.truths()
    if name not in truths:
        raise _RefusedCall(NOT_FOUND, f"there is no '{name}'; there are {', '.join(truths) or 'no states yet'}")
    return truths[name]


def _state_of_entity(control: RunControl, request: Any) -> tuple[object, ...]:
    return _result(), _entity_state(*_row_and_state(control, request.entity))


def _entity_state(time_ns: int, state: VehicleState) -> ros.RosMessage:
    """Velocities in the frame of the header; accelerations are not known: zero."""
    turning = ros.rotated(state.attitude, state.angular_velocity)
    still = ros.vector(0.0, 0.0, 0.0)
    place = ros.pose(state.position, state.attitude)
    rates = ros.twist(state.velocity, turning), ros.make("geometry_msgs/Accel", still, still)
    return _message("EntityState", ros.header(time_ns, "map"), place, *rates)


def _place(control: RunControl, request: Any) -> tuple[object, ...]:
    """Put an obstacle somewhere else, where it rests."""
    _row_and_state(control, request.entity)
    if request.entity not in control.obstacles:
        raise _RefusedCall(UNSUPPORTED, f"{request.entity} is a vehicle: only obstacles that can be pushed are placed")
    if request.set_acceleration or (request.set_twist and not _is_still(request.state.twist)):
        raise _RefusedCall(UNSUPPORTED, "an obstacle that is placed rests")
    if request.state.header.frame_id not in FRAMES:
        raise _RefusedCall(UNSUPPORTED, f"the frame must be map, not {request.state.header.frame_id}")
    if request.set_pose:
        place, yaw = request.state.pose.position, _heading(request.state.pose.orientation)
        control.move(request.entity, (place.x, place.y), yaw)
    return (_result(),)


def _is_still(twist: Any) -> bool:
    return all(number == 0.0 for part in (twist.linear, twist.angular) for number in (part.x, part.y, part.z))


def _heading(turn: Any) -> float:
    """Yaw of an upright attitude, rad."""
    norm = math.hypot(turn.w, turn.x, turn.y, turn.z)
    if not abs(norm - 1.0) <= UNIT_WITHIN:  # also refuses NaN
        raise _RefusedCall(INVALID_POSE, "its orientation is not a rotation")
    if 2.0 * math.hypot(turn.x, turn.y) > UPRIGHT_WITHIN:
        raise _RefusedCall(INVALID_POSE, "obstacles are placed upright: turn them about the vertical axis only")
    return yaw_of((turn.w / norm, turn.x / norm, turn.y / norm, turn.z / norm))
