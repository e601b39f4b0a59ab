"""VCMVSP: many vehicles, one clock, one emulated radio. What authors of agents and users of notebooks need is here.

Everything is loaded on first use, so that ``import cosim`` costs nothing and a robot needs neither PyBullet nor OpenCV.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.agent import Agent, Observation, Radio, VehicleInfo
    from cosim.api import Result, run
    from cosim.errors import AgentError, FederateError, Interrupted, ScenarioError, UsageError, VcmvspError
    from cosim.frames import arc, quaternion_from_yaw, rotate2, wrap, yaw_of
    from cosim.types import (
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
    "cosim.agent": ("Agent", "Observation", "Radio", "VehicleInfo"),
    "cosim.api": ("Result", "run"),
    "cosim.errors": ("AgentError", "FederateError", "Interrupted", "ScenarioError", "UsageError", "VcmvspError"),
    "cosim.frames": ("arc", "quaternion_from_yaw", "rotate2", "wrap", "yaw_of"),
    "cosim.studies.engine": ("study",),
    "cosim.types": (
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
        raise AttributeError(f"module 'cosim' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
