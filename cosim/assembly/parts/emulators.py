"""Emulated devices, served at a real port until they are interrupted: robots, tags of positioning systems, autopilots."""

from functools import partial
from typing import Any

from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.emulators.programs.arcos import Ready, emulate_tag
from vcmvsp.hardware.emulators.programs.arcos import emulate as emulate_robot
from vcmvsp.hardware.emulators.programs.options import Tags, circle_of, duration_of, robot_options, tags_of
from vcmvsp.hardware.emulators.programs.scenario import emulate
from vcmvsp.physics.vehicles.specification import flies

__all__ = [
    "Ready",
    "Tags",
    "circle_of",
    "duration_of",
    "emulate_autopilot",
    "emulate_robot",
    "emulate_ros2_robot",
    "emulate_tag",
    "emulate_vehicle",
    "robot_options",
    "tags_of",
]


emulate_vehicle = partial(emulate, flies=flies)
"""Serves an emulated robot that drives in the world of a scenario (`hardware.emulators.programs.scenario.emulate`)."""


def emulate_autopilot(
    port: str,
    ready: Ready,
    *,
    autopilot: str,
    kind: str,
    system_id: int,
    armed: bool,
    pose: Vec3 | None,
    duration_s: float | None,
) -> dict[str, Any]:
    """`hardware.emulators.programs.mavlink.emulate`; MAVLink loads for this function only."""
    from vcmvsp.hardware.emulators.programs.mavlink import emulate

    return emulate(
        port,
        ready,
        autopilot=autopilot,  # type: ignore[arg-type]  # checked there
        kind=kind,  # type: ignore[arg-type]  # checked there
        system_id=system_id,
        armed=armed,
        pose=pose,
        duration_s=duration_s,
    )


def emulate_ros2_robot(
    port: str, ready: Ready, *, stamped: bool, pose: Vec3 | None, duration_s: float | None
) -> dict[str, Any]:
    """`hardware.emulators.programs.ros2.emulate`; Zenoh and ROS messages load for this function only."""
    from vcmvsp.hardware.emulators.programs.ros2 import emulate

    return emulate(port, ready, stamped=stamped, pose=pose, duration_s=duration_s)
