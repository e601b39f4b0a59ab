"""Betaflight's simulator target (src/platform/SIMULATOR/sitl.c and target/SITL/target.h of Betaflight 4.6), over UDP.

Each step the firmware gets ``fdm_packet`` at port 9003, 18 doubles: time, rates, accelerations, attitude, velocity, place,
pressure. It answers once with ``servo_packet_raw`` to port 9001: number of motors, and 16 pulse widths, microseconds,
in its own order of motors, which ``servo_packet`` (port 9002) changes between versions. ``rc_packet`` at port 9004 has the
channels of a remote control. All little-endian. Its clock follows the times of the packets by their ratio to the wall clock, so
steps come no faster than that. The first packet after half a second without any sets only its clock, without an answer.

Ports are fixed, and open to other machines. So the run starts each firmware in a network of its own; one can be started by
hand.

Motors of the mixer QUADX, propellers inwards (``yaw_motors_reversed = OFF``): back right clockwise, front right and back left
counter-clockwise, front left clockwise. A rotor turns at (pulse - 1000) / 1000 of its greatest speed.

The packet has rates and attitude in FRD and NED, accelerations in FLU with the other sign (sitl.c, and imuComputeRotationMatrix
of imu.c). The attitude is the true one (``USE_IMU_CALC`` is undefined there), and so is the receiver's velocity, in ENU.
"""

import contextlib
import math
import socket
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.types import Vec3, VehicleState
from vcmvsp.hardware.drivers.mavlink.protocol import attitude_flipped, body_flipped
from vcmvsp.hardware.firmware.atmosphere import pressure_hpa
from vcmvsp.hardware.firmware.link import LOOPBACK, FirmwareLost, FirmwareProcess, UdpFirmware

STATE_PORT, STICKS_PORT = 9003, 9004
OUTPUTS = struct.Struct("<H2x16f")  # servo_packet_raw
STATE = struct.Struct("<18d")  # fdm_packet
STICKS = struct.Struct("<d16H")  # rc_packet
MOTORS = 4
ORDER = (1, 2, 3, 0)  # the firmware's motor by the run's: front right, back left, front left, back right
LEAST_US, SPAN_US = 1000.0, 1000.0  # pulse width at standstill, and up to the greatest speed
HOME: Vec3 = (47.397742, 8.545594, 488.0)  # degrees and m: that of `px4`, since the firmware has none
AGAIN_S = 0.05  # wall-clock time after which a packet is repeated
BOOT_S = 1.0  # wall-clock time before the first packet: one that comes before its sensors exist ends the program (sitl.c)
STARTER = Path(__file__).with_name("private_network.py")


class Betaflight(UdpFirmware):
    """Betaflight (``betaflight_SITL``), UDP ports 9001 to 9004; started by the run, each in a network of its own."""

    base_port, port_step, home, free_runs, at_wall_pace, has_sticks = 9001, 0, HOME, True, True, True

    state: VehicleState | None = None
    _packet = b""  # the last one sent
    _sent_s = 0.0  # wall clock
    _booted_s = 0.0  # wall clock
    _strange = 0
    _height_m = 0.0  # of the last reading of the barometer
    _place: Vec3 | None = None  # degrees and m, of the last fix

    def listen(self) -> None:
        """Open the UDP port, if it is started by hand."""
        if not self._words:
            super().listen()

    def start(self) -> None:
        """Start the process in a network of its own, and take over a socket from there."""
        if not self._words or self._process is not None:
            return
        own_end, child_end = socket.socketpair()
        with own_end, child_end:
            starter = [sys.executable, "-I", str(STARTER), str(child_end.fileno()), str(self.port)]
            self._booted_s = time.monotonic() + BOOT_S
            self._process = FirmwareProcess([*starter, *self._words], keep=child_end.fileno())
            child_end.close()
            own_end.settimeout(self.start_s)
            with contextlib.suppress(OSError):
                _, descriptors, _, _ = socket.recv_fds(own_end, 1, 1)
                if descriptors:
                    self._use(socket.socket(fileno=descriptors[0]))
        if self._socket is None:
            raise FirmwareLost(f"its process {self._process.why_ended(wait_s=1.0) or 'does not start'}")

    @property
    def is_alone(self) -> bool:
        """Whether its ports are in a network of its own."""
        return bool(self._words)

    def send(self, readings: FlightReadings) -> None:
        """Send the state."""
        self.state = readings.state
        if readings.height_m is not None:
            self._height_m = readings.height_m
        if readings.fix is not None:
            latitude, longitude, height_m = self.plane.geodetic(*readings.fix.position)
            self._place = (latitude, longitude, height_m)
        self._packet = state_packet(readings, self._place or self.origin, 100.0 * pressure_hpa(self.origin[2] + self._height_m))
        self._write()

    def receive(self) -> bool:
        """Read outputs; a packet without an answer is repeated."""
        fresh = False
        for data, _ in self._datagrams():
            outputs = outputs_of(data)
            if outputs is None:
                self._strange += 1
            else:
                self.outputs, fresh = outputs, True
        if not fresh and time.monotonic() > self._sent_s + AGAIN_S:
            self._write()
        return fresh

    def steer(self, now_ns: int, channels: Sequence[int]) -> None:
        """Send the channels of a remote control, microseconds: roll, pitch, throttle, yaw, AUX 1 and so on."""
        rest = [1000] * (16 - len(channels))
        self._to(STICKS_PORT, STICKS.pack(1e-9 * now_ns, *channels, *rest))

    @property
    def refused(self) -> str:
        """Datagrams of another protocol or version."""
        return f"{self._strange} datagrams of another protocol" if self._strange else ""

    def _write(self) -> None:
        self._sent_s = time.monotonic()
        if self._sent_s >= self._booted_s:
            self._to(STATE_PORT, self._packet)

    def _to(self, port: int, packet: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens yet
            self._open.sendto(packet, (LOOPBACK, port))


def outputs_of(datagram: bytes) -> tuple[float, ...] | None:
    """Shares of the greatest speed, front right, back left, front left, back right; None: not of a quadrotor's firmware."""
    if len(datagram) != OUTPUTS.size:
        return None
    count, *pulses = OUTPUTS.unpack(datagram)
    if count != MOTORS or not all(map(math.isfinite, pulses)):
        return None
    return tuple(min(max((pulses[k] - LEAST_US) / SPAN_US, 0.0), 1.0) for k in ORDER)


def state_packet(readings: FlightReadings, place: Vec3, pressure_pa: float) -> bytes:
    """``fdm_packet`` with a virtual receiver: ``place`` is latitude and longitude, degrees, and height, m."""
    latitude, longitude, height_m = place
    ax, ay, az = readings.imu.acceleration
    motion = (*body_flipped(readings.imu.angular_velocity), -ax, -ay, -az, *attitude_flipped(readings.state.attitude))
    position = (*readings.state.velocity, longitude, latitude, height_m)
    return STATE.pack(1e-9 * readings.now_ns, *motion, *position, pressure_pa)
