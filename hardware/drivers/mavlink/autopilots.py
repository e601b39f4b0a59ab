"""Differences between autopilots: numbers of their modes, and their conditions for set-points.

Sources: PX4 ``px4_custom_mode.h`` (main mode in bits 16-23, sub-mode in bits 24-31); ArduPilot ``Copter/mode.h`` and
``Rover/mode.h``; types of vehicles: MAVLink ``MAV_TYPE``.
"""

from typing import Literal

from vcmvsp.cosim.types import Value
from vcmvsp.hardware.drivers.mavlink.codec import Message, mavlink

Kind = Literal["px4", "ardupilot"]

ROVER, BOAT = mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_TYPE_SURFACE_BOAT
COPTERS = frozenset(
    (
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
        mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
    )
)
GROUND = frozenset((ROVER, BOAT))


def type_name(number: int) -> str:
    """The kind of a vehicle in words."""
    entry = mavlink.enums["MAV_TYPE"].get(number)
    return entry.name.removeprefix("MAV_TYPE_").lower().replace("_", " ") if entry else f"vehicle of type {number}"


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


_PX4 = {
    "MANUAL": _px4(1),
    "ALTITUDE": _px4(2),
    "POSITION": _px4(3),
    "ORBIT": _px4(3, 1),
    "READY": _px4(4, 1),
    "TAKEOFF": _px4(4, 2),
    "HOLD": _px4(4, 3),
    "MISSION": _px4(4, 4),
    "RETURN": _px4(4, 5),
    "LAND": _px4(4, 6),
    "FOLLOW": _px4(4, 8),
    "PRECISION LAND": _px4(4, 9),
    "ACRO": _px4(5),
    "OFFBOARD": _px4(6),
    "STABILIZED": _px4(7),
}
_COPTER = {
    "STABILIZE": 0,
    "ACRO": 1,
    "ALT_HOLD": 2,
    "AUTO": 3,
    "GUIDED": 4,
    "LOITER": 5,
    "RTL": 6,
    "CIRCLE": 7,
    "LAND": 9,
    "DRIFT": 11,
    "SPORT": 13,
    "FLIP": 14,
    "AUTOTUNE": 15,
    "POSHOLD": 16,
    "BRAKE": 17,
    "THROW": 18,
    "GUIDED_NOGPS": 20,
    "SMART_RTL": 21,
    "FLOWHOLD": 22,
    "FOLLOW": 23,
    "ZIGZAG": 24,
}
_ROVER = {
    "MANUAL": 0,
    "ACRO": 1,
    "STEERING": 3,
    "HOLD": 4,
    "LOITER": 5,
    "FOLLOW": 6,
    "SIMPLE": 7,
    "DOCK": 8,
    "CIRCLE": 9,
    "AUTO": 10,
    "RTL": 11,
    "SMART_RTL": 12,
    "GUIDED": 15,
}


class Autopilot(Value, frozen=True, kw_only=True):
    """An autopilot in a kind of vehicle."""

    name: str
    kind: Kind
    modes: dict[str, int]  # name: custom mode
    follows: str  # the mode in which it follows set-points
    holds: tuple[str, ...]  # modes that hold the position, the best first
    lead_s: float  # duration of set-points before the switch to `follows`

    def mode(self, custom_mode: int) -> str:
        """The name of a mode."""
        for name, number in self.modes.items():
            if number == custom_mode:
                return name
        return f"mode {custom_mode:#x}"

    def switch_to(self, mode: str) -> tuple[float, float, float]:
        """Parameters of MAV_CMD_DO_SET_MODE."""
        number = self.modes[mode]
        if self.kind == "px4":
            return mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, number >> 16 & 0xFF, number >> 24
        return mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, number, 0


# PX4 wants set-points at more than 2 Hz for over 1 s before it is switched [PX4 guide, Offboard mode]; ArduPilot wants none.
_PX4_AUTOPILOT = Autopilot(name="PX4", kind="px4", modes=_PX4, follows="OFFBOARD", holds=("HOLD",), lead_s=1.5)


def autopilot_of(kind: Kind, vehicle_type: int) -> Autopilot:
    """The autopilot in a vehicle of this ``MAV_TYPE``.

    A copter is left in BRAKE: in LOITER a transmitter on the table, with its throttle stick low, lands it.
    """
    if kind == "px4":
        return _PX4_AUTOPILOT
    modes = _ROVER if vehicle_type in GROUND else _COPTER
    holds = {ROVER: ("HOLD",), BOAT: ("LOITER", "HOLD")}.get(vehicle_type, ("BRAKE",))
    return Autopilot(name="ArduPilot", kind="ardupilot", modes=modes, follows="GUIDED", holds=holds, lead_s=0.0)


KINDS: dict[int, Kind] = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}


def is_autopilot(heartbeat: Message) -> bool:
    """Whether a heartbeat is of an autopilot, and not of a ground station, a camera or a radio."""
    return bool(heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID)
