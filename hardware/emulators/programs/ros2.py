"""Emulated ROS 2 robot over Zenoh until it is interrupted."""

from typing import Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.emulators.programs.arcos import Ready, until_interrupted, wait
from vcmvsp.hardware.emulators.programs.options import duration_of
from vcmvsp.hardware.emulators.ros2.robot import Ros2Robot


def emulate(
    endpoint: str, ready: Ready, *, stamped: bool = False, pose: Vec3 | None = None, duration_s: float | None = None
) -> dict[str, Any]:
    """Serve a differential drive on an empty floor, and its router; its final state.

    Args:
        endpoint: of Zenoh, where it listens, ``tcp/HOST:PORT``.
        ready: called when it can be connected to.
        stamped: it takes TwistStamped, not Twist.
        pose: start of its odometry, x m, y m, yaw rad.
        duration_s: None: until it is interrupted.

    Raises:
        UsageError: the endpoint cannot be opened.
    """
    duration_of(duration_s)
    robot = Ros2Robot(endpoint=endpoint, stamped=stamped, pose=pose or ORIGIN)
    with until_interrupted():
        try:
            with robot:
                ready({"url": endpoint, "positioning": {}})
                wait(duration_s, lambda: None)
        except PortError as error:
            raise UsageError(f"--port {endpoint}: {error.happened}") from None
    x, y, yaw = robot.pose
    return {"messages": len(robot.heard), "x_m": x, "y_m": y, "yaw_rad": yaw, "fixes": {}}
