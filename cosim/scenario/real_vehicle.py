"""Description of a real vehicle, as a checked scenario gives it."""

from typing import Any

from vcmvsp.cosim.scenario.schema import SafetyTable
from vcmvsp.cosim.types import Value, Vec3


class RealVehicle(Value, frozen=True, kw_only=True):
    """A real vehicle as the scenario describes it."""

    name: str
    folder: str  # of the scenario
    driver: str  # its kind, as written
    driver_params: dict[str, Any]
    localisation: str | None  # its kind, as written
    localisation_params: dict[str, Any]
    fusion: dict[str, Any]
    safety: SafetyTable  # nothing in it is left to a default
    pose_source: str
    start: Vec3  # x m, y m, yaw rad
    height_m: float  # of its reference point above the ground
    flies: bool
    positioning: dict[str, Any] | None  # of its simulated twin, complete
    seed: int
