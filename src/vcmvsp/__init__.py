"""VCMVSP: many vehicles, one clock, one emulated radio. What authors of agents and users of notebooks need is here.

Everything is loaded on first use, so that ``import vcmvsp`` costs nothing and a robot needs neither PyBullet nor OpenCV.
"""

import importlib
from typing import TYPE_CHECKING, Any

if __name__ != "vcmvsp":
    raise ImportError(f"this is vcmvsp: import it by that name, not as '{__name__}'")

if TYPE_CHECKING:
    from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
    from vcmvsp.cosim.errors import AgentError, FederateError, Interrupted, ScenarioError, UsageError, VcmvspError
    from vcmvsp.cosim.frames import arc, quaternion_from_yaw, rotate2, wrap, yaw_of
    from vcmvsp.cosim.received import ReceivedMessages
    from vcmvsp.cosim.runs.api import Result, run
    from vcmvsp.cosim.runs.stepping import SteppedRun, start
    from vcmvsp.cosim.studies.engine import study
    from vcmvsp.cosim.types import (
        Fix,
        Follows,
        Image,
        Imu,
        Measured,
        Message,
        NonNegative,
        Odometry,
        Positive,
        Probability,
        Reception,
        Scan,
        VehicleState,
        Velocity,
        Waypoint,
    )

_HOMES = {
    "vcmvsp.cosim.agent": ("Agent", "Observation", "Radio", "VehicleInfo"),
    "vcmvsp.cosim.received": ("ReceivedMessages",),
    "vcmvsp.cosim.runs.api": ("Result", "run"),
    "vcmvsp.cosim.runs.stepping": ("SteppedRun", "start"),
    "vcmvsp.cosim.errors": ("AgentError", "FederateError", "Interrupted", "ScenarioError", "UsageError", "VcmvspError"),
    "vcmvsp.cosim.frames": ("arc", "quaternion_from_yaw", "rotate2", "wrap", "yaw_of"),
    "vcmvsp.cosim.studies.engine": ("study",),
    "vcmvsp.cosim.types": (
        "Fix",
        "Follows",
        "Image",
        "Imu",
        "Measured",
        "Message",
        "NonNegative",
        "Odometry",
        "Positive",
        "Probability",
        "Reception",
        "Scan",
        "VehicleState",
        "Velocity",
        "Waypoint",
    ),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [  # noqa: RUF022  by topic
    "run",
    "Result",
    "start",
    "SteppedRun",
    "study",
    "Agent",
    "Observation",
    "Radio",
    "VehicleInfo",
    "VehicleState",
    "Velocity",
    "Waypoint",
    "Message",
    "Reception",
    "ReceivedMessages",
    "Follows",
    "Odometry",
    "Fix",
    "Imu",
    "Scan",
    "Image",
    "Measured",
    "Positive",
    "NonNegative",
    "Probability",
    "arc",
    "wrap",
    "rotate2",
    "yaw_of",
    "quaternion_from_yaw",
    "VcmvspError",
    "ScenarioError",
    "UsageError",
    "FederateError",
    "AgentError",
    "Interrupted",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'vcmvsp' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
