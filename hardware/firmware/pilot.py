"""Flies Betaflight by the sticks of a remote control, in place of a person who watches the vehicle: it knows the true state.

The firmware keeps attitudes (mode ANGLE) and turning rates; the pilot keeps velocities. Channels 1 to 4 are roll, pitch,
throttle and yaw, AUX 1 arms, AUX 2 is the mode ANGLE. It arms, takes off to ``takeoff_m``, then follows commands; where a
command goes down and the vehicle stands, it disarms, and arms again for one that goes up.

Deflections are those of the firmware's defaults (Betaflight 4.6, controlrate_profile.c, rc.c and pid.c): rates "actual", 70
degrees/s at the centre and 670 at the end, and angles of up to 60 degrees in proportion to them.
"""

import math
from collections.abc import Iterator

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import VehicleState, Velocity, Waypoint
from vcmvsp.hardware.drivers.base import What
from vcmvsp.hardware.firmware.betaflight import Betaflight
from vcmvsp.hardware.firmware.commander import READY_NS, towards

PERIOD_NS = 20_000_000  # between two packets of a remote control
TRY_NS = SECOND_NS  # for which the arming switch is in one place, until the motors turn
CENTRE_DPS, END_DPS, MOST_DEG = 70.0, 670.0, 60.0
TILT_DEG = 20.0  # that the pilot uses
IDLE = 0.055  # share of the speed of an armed motor (dyn_idle off, motor_idle = 550)
GRAVITY = 9.81  # m/s2
GAIN, LIFT_GAIN, LEARN = 1.2, 3.0, 0.3  # 1/s, 1/s and 1/(m): acceleration by velocity, climb, and trim of the throttle
RISE_MPS, STAND_M = 0.7, 0.1  # speed of the take-off, and height above its start at which it may stand


class StickPilot:
    """Commands one Betaflight (as `MavlinkCommander` commands others)."""

    def __init__(self, firmware: Betaflight) -> None:
        self._firmware = firmware
        self._command: Velocity | Waypoint | None = None
        self._due_ns = self._switched_ns = 0
        self._late_ns: int | None = None
        self._armed = self._up = False  # the switch, and whether it has taken off
        self._start_m = 0.0  # height of its start
        self._trim = 0.3  # share of the greatest speed at which it hovers
        self._stands_ns = 0  # since when it stands

    def command(self, command: Velocity | Waypoint) -> None:
        """Set the newest command."""
        self._command = command

    def advance(self, now_ns: int) -> Iterator[tuple[What, str]]:
        """Move the sticks; yields notices."""
        state = self._firmware.state
        if self._command is None or state is None or now_ns < self._due_ns:
            return
        self._due_ns = now_ns + PERIOD_NS
        if self._late_ns is None:
            self._late_ns, self._start_m, self._switched_ns = now_ns + READY_NS, state.position[2], now_ns
        if min(self._firmware.outputs) > 0.0 and self._armed:
            self._firmware.steer(now_ns, self._flying(self._command, state, now_ns))
            return
        self._firmware.steer(now_ns, self._standing(self._command, state, now_ns))
        if 0 < self._late_ns <= now_ns and not self._up:
            self._late_ns = 0
            yield "warned", "its firmware does not arm: its configuration lets AUX 1 arm, and AUX 2 switch the mode ANGLE on"

    def close(self) -> None:
        """Nothing is open."""

    def _standing(self, command: Velocity | Waypoint, state: VehicleState, now_ns: int) -> list[int]:
        """Channels on the ground: the switch goes up again and again, until the motors turn."""
        self._trim = 0.3
        climbs = not self._up or towards(command, state).linear[2] > 0.0
        if now_ns - self._switched_ns >= TRY_NS:
            self._switched_ns, self._armed = now_ns, climbs and not self._armed
        return _channels(0.0, 0.0, 0.0, 0.0, armed=self._armed)

    def _flying(self, command: Velocity | Waypoint, state: VehicleState, now_ns: int) -> list[int]:
        target, height_m = self._target_velocity(command, state), state.position[2] - self._start_m
        if target.linear[2] >= 0.0 or height_m > STAND_M:
            self._stands_ns = now_ns
        elif now_ns - self._stands_ns >= SECOND_NS // 2:
            self._armed, self._switched_ns = False, now_ns
            return _channels(0.0, 0.0, 0.0, 0.0, armed=False)
        (vx, vy, vz), (wx, wy, wz) = state.velocity, target.linear
        self._trim = min(max(self._trim + LEARN * (wz - vz) * 1e-9 * PERIOD_NS, 0.1), 0.9)
        ahead, left = rotate2(GAIN * (wx - vx), GAIN * (wy - vy), -state.yaw)
        nose_down, roll_right = (_tilt_deg(each) for each in (ahead, -left))
        lift = max(0.2, 1.0 + LIFT_GAIN * (wz - vz) / GRAVITY) / math.cos(math.radians(math.hypot(nose_down, roll_right)))
        share = self._trim * math.sqrt(lift)
        yaw = -_deflection(math.degrees(target.yaw_rate) / END_DPS)
        roll, pitch = (_deflection(each / MOST_DEG) for each in (roll_right, nose_down))
        return _channels(roll, pitch, (share - IDLE) / (1.0 - IDLE), yaw, armed=True)

    def _target_velocity(self, command: Velocity | Waypoint, state: VehicleState) -> Velocity:
        self._up = self._up or state.position[2] - self._start_m >= self._firmware.takeoff_m
        return towards(command, state) if self._up else Velocity(linear=(0.0, 0.0, RISE_MPS))


def _tilt_deg(acceleration: float) -> float:
    return min(max(math.degrees(math.atan2(acceleration, GRAVITY)), -TILT_DEG), TILT_DEG)


def _deflection(share: float) -> float:
    """Deflection of a stick, -1 to 1, for a share of its greatest rate: c d + (e - c) d |d| = e share."""
    slope = END_DPS - CENTRE_DPS
    root = math.sqrt(CENTRE_DPS**2 + 4.0 * slope * END_DPS * min(abs(share), 1.0))
    return math.copysign((root - CENTRE_DPS) / (2.0 * slope), share)


def _channels(roll: float, pitch: float, throttle: float, yaw: float, *, armed: bool) -> list[int]:
    """Pulse widths, microseconds; the throttle starts at 1050 (``min_check``) and arming needs less."""
    lift = round(1050.0 + 950.0 * min(max(throttle, 0.0), 1.0)) if throttle > 0.0 else 1000
    a, e, r = (round(1500.0 + 500.0 * each) for each in (roll, pitch, yaw))
    return [a, e, lift, r, 2000 if armed else 1000, 2000]
