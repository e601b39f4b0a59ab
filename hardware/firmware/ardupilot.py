"""ArduPilot's JSON interface (libraries/SITL/examples/JSON/readme.md and SIM_JSON.cpp of ArduPilot), over UDP.

The firmware (``arducopter --model JSON --instance N``) sends a datagram of servo outputs to port 9002 + 10 N and waits for a
line of readings, which goes to the address that the outputs came from; then it runs for the time since the last line. It sends
again after a second without an answer. Outputs, little-endian: magic number 18458 with 16 channels or 29569 with 32, rate,
number of the frame, pulse widths in microseconds. Readings: NED and FRD, as quaternion, specific force without gravity.

Channels 1 to 4 are the motors of a quadrotor as an x (FRAME_CLASS 1, FRAME_TYPE 1; AP_MotorsMatrix.cpp): front right and back
left, counter-clockwise, front left and back right, clockwise. A rotor turns at (pulse - 1000) / 1000 of its greatest speed, as
in the Gazebo plug-in of ArduPilot (ardupilot_gazebo, model iris: multiplier 838 rad/s, offset 0).

Position, velocity and attitude are the true ones: ArduPilot adds the errors of its barometer, compass and receiver itself
(parameters SIM_*). The inertial readings are those of the vehicle's sensor.
"""

import json
import struct

from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.drivers.mavlink.protocol import attitude_flipped, body_flipped, world_flipped
from vcmvsp.hardware.firmware.link import UdpFirmware

MAGIC = {18458: 16, 29569: 32}  # channels by magic number
HEAD = struct.Struct("<HHI")  # magic number, rate in Hz, number of the frame
LEAST_US, SPAN_US = 1000.0, 1000.0  # pulse width at standstill, and up to the greatest speed
HOME: Vec3 = (-35.363261, 149.165230, 584.0)  # degrees and m: ArduPilot's default in simulation (sim_vehicle.py, CMAC)


class ArduPilot(UdpFirmware):
    """ArduPilot (``arducopter``) on the JSON interface, UDP port 9002 + 10 per instance."""

    base_port, port_step, home = 9002, 10, HOME

    _peer: tuple[str, int] | None = None
    _frame = -1  # number of the newest one
    _line = b""  # the last one sent
    _strange, _strangers = 0, 0

    def send(self, readings: FlightReadings) -> None:
        """Send a line, once the address is known."""
        self._line = line_of(readings)
        self._write()

    def receive(self) -> bool:
        """Read datagrams; a repeated one gets the last line again."""
        fresh = False
        for data, sender in self._datagrams():
            fresh |= self._take(data, sender)
        return fresh

    @property
    def refused(self) -> str:
        """Datagrams of another protocol or from another sender."""
        counts = {"of another protocol": self._strange, "of a second sender": self._strangers}
        return " and ".join(f"{count} datagrams {which}" for which, count in counts.items() if count)

    def _take(self, data: bytes, sender: tuple[str, int]) -> bool:
        """Take a datagram; whether it has new outputs."""
        answer = outputs_of(data)
        if answer is None:
            self._strange += 1
            return False
        if self._peer not in (None, sender):
            self._strangers += 1
            return False
        self._peer = sender
        number, outputs = answer
        if number == self._frame:  # the line was lost
            self._write()
            return False
        self._frame, self.outputs = number, outputs
        return True

    def _write(self) -> None:
        if self._peer is not None and self._line:
            try:
                self._open.sendto(self._line, self._peer)
            except OSError:  # it asks again
                return


def outputs_of(datagram: bytes) -> tuple[int, tuple[float, ...]] | None:
    """Number of a frame, and shares of the greatest speed of motors 1 to 4; None: not of this protocol."""
    if len(datagram) < HEAD.size:
        return None
    magic, _, number = HEAD.unpack_from(datagram)
    channels = MAGIC.get(magic)
    if channels is None or len(datagram) != HEAD.size + 2 * channels:
        return None
    pulses = struct.unpack_from("<4H", datagram, HEAD.size)
    return number, tuple(min(max((pulse - LEAST_US) / SPAN_US, 0.0), 1.0) for pulse in pulses)


def line_of(readings: FlightReadings) -> bytes:
    """The line of readings, between two line feeds."""
    state = readings.state
    content = {
        "timestamp": 1e-9 * readings.now_ns,
        "imu": {
            "gyro": body_flipped(readings.imu.angular_velocity),
            "accel_body": body_flipped(readings.imu.acceleration),
        },
        "position": world_flipped(state.position),
        "quaternion": attitude_flipped(state.attitude),
        "velocity": world_flipped(state.velocity),
    }
    return f"\n{json.dumps(content, separators=(',', ':'))}\n".encode()
