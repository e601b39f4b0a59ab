"""PX4's simulator interface (simulator_mavlink, SimulatorMavlink.cpp of PX4): MAVLink over TCP.

The firmware (``px4 -i N`` with ``PX4_SIM_MODEL=none_iris``) connects to port 4560 + N. Each step it gets HIL_SENSOR, which sets
its clock, and answers with HIL_ACTUATOR_CONTROLS; HIL_GPS comes at the receiver's rate, and HIL_STATE_QUATERNION at the
interval that the firmware asks for (MAV_CMD_SET_MESSAGE_INTERVAL), as the ground truth of its log. While it boots, it sends no
controls but needs readings: so the run goes on without it, no faster than the wall clock, until the first controls (as PX4's
bridge to Gazebo does: ``received_first_actuator``).

Controls 1 to 4 are the motors of a quadrotor as an x (CA_ROTOR0 to 3 of the airframes iris and x500): front right and back
left, counter-clockwise, front left and back right, clockwise; from 0 to 1 (PWMSim.cpp), 0 while disarmed. A rotor turns at that
share of its greatest speed.

HIL_SENSOR comes at 250 Hz at most, since PX4 answers no more often (IMU_GYRO_RATEMAX; so does PX4's bridge to Gazebo): at a
higher rate of physics, steps between two messages keep the last outputs.

Pressure follows the standard atmosphere (ISO 2533). The receiver's velocity is the true one.
"""

import math
import socket

from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.types import Fix, Vec3
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.protocol import Message, attitude_flipped, body_flipped, mavlink, world_flipped
from vcmvsp.hardware.firmware.atmosphere import pressure_hpa, temperature_c
from vcmvsp.hardware.firmware.link import LOOPBACK, FirmwareLink, FirmwareLost

HOME: Vec3 = (47.397742, 8.545594, 488.0)  # degrees and m: PX4's default in simulation (gazebo_mavlink_interface.h)
ACCEL, GYRO, MAG, BARO = 0b111, 0b11_1000, 0b1_1100_0000, 0b1_1010_0000_0000
"""Bits of ``fields_updated``: of barometer absolute pressure, pressure altitude and temperature."""
UT_PER_GAUSS = 100.0
SATELLITES, FIX_3D = 10, 3
STILL: Vec3 = (0.0, 0.0, 0.0)
GRAVITY = 9.80665  # m/s2, standard
BYTES = 65536
LEAST_NS = 4_000_000  # between two messages of the sensors
START_US = 1000  # a clock at 0 counts as not set


class Px4(FirmwareLink):
    """PX4 (``px4``) on its simulator interface, TCP port 4560 + instance."""

    base_port, port_step, home, free_runs = 4560, 1, HOME, True

    _listener: socket.socket | None = None  # until it has connected
    _line: socket.socket | None = None
    _reader: protocol.MessageReader
    _encode: protocol.Encoder
    _truth_every_ns = 0  # interval of HIL_STATE_QUATERNION; 0: not asked for
    _truth_ns = 0  # time of the next
    _height_m = 0.0  # of the last reading of the barometer
    _bytes = 0  # received
    _next_ns = 0  # time of the next message of the sensors
    _between = False  # whether this step has none
    _field_ut: Vec3 | None = None  # readings since the last message
    _fix: Fix | None = None
    _has_height = False

    def listen(self) -> None:
        """Open the TCP port."""
        if self._listener is None and self._line is None:
            self._listener = socket.create_server((LOOPBACK, self.port), backlog=1)
            self._listener.setblocking(False)
            self._reader = protocol.MessageReader()
            self._encode = protocol.Encoder(protocol.Sender(system=1, component=mavlink.MAV_COMP_ID_AUTOPILOT1))

    def fileno(self) -> int:
        """The connection, before it the listening socket."""
        opened = self._line or self._listener
        assert opened is not None  # noqa: S101  `listen` was called
        return opened.fileno()

    def send(self, readings: FlightReadings) -> None:
        """Send the messages of a step, once it has connected."""
        if self._line is None:
            return
        self._field_ut = readings.field_ut or self._field_ut
        self._fix = readings.fix or self._fix
        if readings.height_m is not None:
            self._height_m, self._has_height = readings.height_m, True
        self._between = readings.now_ns < self._next_ns
        if self._between:
            return
        self._next_ns = readings.now_ns + LEAST_NS
        messages = [self._sensors(readings)]
        if self._fix is not None:
            messages.append(self._gps(self._fix, readings))
        if self._truth_every_ns and readings.now_ns >= self._truth_ns:
            self._truth_ns = readings.now_ns + self._truth_every_ns
            messages.append(self._truth(readings))
        try:
            self._line.sendall(self._encode(*messages))
        except BlockingIOError:
            raise FirmwareLost("it does not read its connection") from None
        except OSError as error:
            raise FirmwareLost(f"its connection broke: {error.strerror or error}") from error

    def receive(self) -> bool:
        """Accept the connection, or read messages."""
        if self._line is None:
            self._accept()
            return False
        if self._between and self.started:
            return True
        try:
            data = self._line.recv(BYTES)
        except BlockingIOError:
            return False
        except OSError as error:
            raise FirmwareLost(f"its connection broke: {error.strerror or error}") from error
        if not data:
            raise FirmwareLost("it closed its connection")
        self._bytes += len(data)
        fresh = False
        for message in self._reader.feed(data):
            fresh |= self._take(message)
        return fresh

    @property
    def refused(self) -> str:
        """Bytes that are no MAVLink."""
        return f"{self._bytes} bytes without a MAVLink message" if self._bytes and not self._reader.messages else ""

    def close(self) -> None:
        """End the process and the connection."""
        super().close()
        for each in (self._line, self._listener):
            if each is not None:
                each.close()
        self._line = self._listener = None

    def _accept(self) -> None:
        assert self._listener is not None  # noqa: S101  `listen` was called
        try:
            self._line, _ = self._listener.accept()
        except BlockingIOError:
            return
        self._line.setblocking(False)
        self._line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._listener.close()  # there is one firmware
        self._listener = None

    def _take(self, message: Message) -> bool:
        """Take a message; whether it has new outputs."""
        match message.get_type():
            case "HIL_ACTUATOR_CONTROLS":
                armed = bool(message.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                self.outputs = tuple(map(_share, message.controls[:4])) if armed else (0.0,) * 4
                return True
            case "COMMAND_LONG" if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                if message.param1 == mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION and math.isfinite(message.param2):
                    self._truth_every_ns = max(0, round(1000 * message.param2))
        return False

    def _sensors(self, readings: FlightReadings) -> Message:
        ax, ay, az = body_flipped(readings.imu.acceleration)
        gx, gy, gz = body_flipped(readings.imu.angular_velocity)
        updated, (mx, my, mz) = ACCEL | GYRO, STILL
        if self._field_ut is not None:
            updated |= MAG
            mx, my, mz = body_flipped(self._field_ut)
        updated |= BARO if self._has_height else 0
        self._field_ut, self._has_height = None, False
        height_m = self.origin[2] + self._height_m
        return mavlink.MAVLink_hil_sensor_message(
            START_US + readings.now_ns // 1000,
            *(ax, ay, az, gx, gy, gz),
            *(mx / UT_PER_GAUSS, my / UT_PER_GAUSS, mz / UT_PER_GAUSS),
            pressure_hpa(height_m),
            0.0,
            height_m,
            temperature_c(height_m),
            updated,
        )

    def _gps(self, fix: Fix, readings: FlightReadings) -> Message:
        self._fix = None
        latitude, longitude, height_m = self.plane.geodetic(*fix.position)
        north, east, down = (round(100.0 * each) for each in world_flipped(readings.state.velocity))
        course = round(math.degrees(math.atan2(east, north)) * 100.0) % 36000
        sigma_z_m = fix.sigma_m if fix.sigma_z_m is None else fix.sigma_z_m
        return mavlink.MAVLink_hil_gps_message(
            START_US + readings.now_ns // 1000,
            FIX_3D,
            *(round(1e7 * latitude), round(1e7 * longitude), round(1e3 * height_m)),
            *(_centimetres(fix.sigma_m), _centimetres(sigma_z_m)),
            round(math.hypot(north, east)),
            *(north, east, down),
            course,
            SATELLITES,
        )

    def _truth(self, readings: FlightReadings) -> Message:
        state = readings.state
        latitude, longitude, height_m = self.plane.geodetic(*state.position)
        velocity = (round(100.0 * each) for each in world_flipped(state.velocity))
        force = (max(-32768, min(32767, round(1e3 * each / GRAVITY))) for each in body_flipped(readings.imu.acceleration))
        return mavlink.MAVLink_hil_state_quaternion_message(
            START_US + readings.now_ns // 1000,
            attitude_flipped(state.attitude),
            *body_flipped(state.angular_velocity),
            *(round(1e7 * latitude), round(1e7 * longitude), round(1e3 * height_m)),
            *velocity,
            *(0, 0),
            *force,
        )


def _share(control: float) -> float:
    """A control as a share of the greatest speed; NaN stands for a motor that is off."""
    return min(max(control, 0.0), 1.0) if math.isfinite(control) else 0.0


def _centimetres(sigma_m: float) -> int:
    return min(65535, round(100.0 * sigma_m))
