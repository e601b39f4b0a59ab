"""Autopilot of a quadrotor in X configuration, as a separate program by pymavlink and the published protocols, without our
code.

It imitates ArduPilot on the JSON interface or PX4 on the simulator interface, and flies by the true state that both give:
PX4's by HIL_STATE_QUATERNION, which it requests. Without ``--commanded`` it flies a mission: take-off, way-points, landing.
With it, it is also a MAVLink vehicle that follows a ground station: mode, arming, take-off, velocities.

Control is geometric (T. Lee, M. Leok, N. H. McClamroch, Geometric tracking control of a quadrotor UAV on SE(3), CDC 2010), all
in NED and FRD; the mixer is derived here from places and turning directions of the rotors in the firmware's own documents.
"""

import argparse
import json
import math
import os
import socket
import struct
import sys
import time
from typing import Any

os.environ["MAVLINK20"] = "1"
import numpy as np
from pymavlink.dialects.v20 import common as mavlink  # type: ignore[import-untyped]

MASS, ARM, MOST_N = 0.80, 0.165 * math.sqrt(0.5), 7.9e-6 * 838.0**2  # kg, m, N of one rotor
YAW_M = 1.47e-7 / 7.9e-6  # N m of yaw per N
G = 9.81
# Forward and right of each motor, m, and the sign of the yaw torque of its drag on the body, clockwise seen from above.
MOTORS = np.array([(1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)], float)
MIX = np.linalg.inv(np.array([np.ones(4), -ARM * MOTORS[:, 1], ARM * MOTORS[:, 0], YAW_M * MOTORS[:, 2]]))
EARTH_M = 6378137.0
MISSION = ((0.5, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0, 1.0), (5.5, 1.5, 0.0, 1.0), (8.0, 1.5, 1.0, 1.0))
"""Until when, s: north, east, height of the target, m."""


def rotation(q: Any) -> Any:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class State:
    """True state: NED, body FRD."""

    time_s = 0.0
    position = np.zeros(3)
    velocity = np.zeros(3)
    q = (1.0, 0.0, 0.0, 0.0)
    rate = np.zeros(3)


class Pilot:
    """Target, arming and outputs."""

    def __init__(self, commanded: bool) -> None:
        self.commanded, self.armed, self.mode = commanded, False, ""
        self.rise_to: float | None = None
        self.start: Any = None
        self.velocity, self.yaw_rate, self.yaw = np.zeros(3), 0.0, 0.0
        self.last_s = 0.0

    def outputs(self, now: State) -> list[float]:
        if self.start is None:
            self.start = now.position.copy()
            self.yaw = math.atan2(rotation(now.q)[1, 0], rotation(now.q)[0, 0])
        dt, self.last_s = now.time_s - self.last_s, now.time_s
        velocity = self.commanded_velocity(now) if self.commanded else self.mission(now)
        self.yaw += self.yaw_rate * dt
        if not self.armed:
            return [0.0] * 4
        push = 3.0 * (velocity - now.velocity) - np.array([0.0, 0.0, G])
        r = rotation(now.q)
        down = -push / np.linalg.norm(push)
        right = np.cross(down, [math.cos(self.yaw), math.sin(self.yaw), 0.0])
        right /= np.linalg.norm(right)
        want = np.column_stack([np.cross(right, down), right, down])
        error = 0.5 * (want.T @ r - r.T @ want)
        e = np.array([error[2, 1], error[0, 2], error[1, 0]])
        torque = np.array([0.004, 0.004, 0.0073]) * (
            -np.array([120.0, 120.0, 20.0]) * e - np.array([20.0, 20.0, 8.0]) * now.rate
        )
        thrust = MASS * max(0.0, -float(push @ r[:, 2]))
        force = np.clip(MIX @ np.concatenate([[thrust], torque]), 0.0, MOST_N)
        return np.sqrt(force / MOST_N).tolist()

    def commanded_velocity(self, now: State) -> Any:
        if self.rise_to is not None:
            if self.start[2] - now.position[2] >= self.rise_to:
                self.rise_to = None
            return np.array([0.0, 0.0, -0.7])
        return self.velocity

    def mission(self, now: State) -> Any:
        until = [row for row in MISSION if now.time_s < row[0]]
        self.armed = now.time_s > 0.2 and (bool(until) or now.position[2] < self.start[2] - 0.03)
        if not until:
            return np.array([0.0, 0.0, 0.8])
        _, north, east, height = until[0]
        way = self.start + np.array([north, east, -height]) - now.position
        way *= min(1.2, 2.5 / max(float(np.linalg.norm(way)), 1e-9))
        return np.array([*way[:2], max(-1.5, min(1.5, way[2]))])


class Ground:
    """MAVLink side: a ground station at this UDP port."""

    def __init__(self, pilot: Pilot, kind: str, port: int, home: tuple[float, float, float]) -> None:
        self.pilot, self.kind, self.to, self.home = pilot, kind, ("127.0.0.1", port), home
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.mav.robust_parsing = True
        self.beat_s = self.telemetry_s = 0.0

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self.to)
        self.mav.seq = (self.mav.seq + 1) % 256

    def exchange(self, now: State) -> None:
        while True:
            try:
                data, self.to = self.socket.recvfrom(4096)
            except OSError:
                break
            for message in self.mav.parse_buffer(data) or []:
                self.obey(message)
        if now.time_s >= self.beat_s:
            self.beat_s = now.time_s + 1.0
            mode = {"px4": 6 << 16 if self.pilot.mode else 3 << 16, "ardupilot": 4 if self.pilot.mode else 5}[self.kind]
            base = 1 | (128 if self.pilot.armed else 0)
            self.send(mavlink.MAVLink_heartbeat_message(2, 12 if self.kind == "px4" else 3, base, mode, 4, 3))
        if now.time_s >= self.telemetry_s:
            self.telemetry_s = now.time_s + 0.05
            ms, r = int(1e3 * now.time_s), rotation(now.q)
            roll, pitch, yaw = math.atan2(r[2, 1], r[2, 2]), -math.asin(r[2, 0]), math.atan2(r[1, 0], r[0, 0])
            north, east, down = now.position
            latitude = self.home[0] + math.degrees(north / EARTH_M)
            longitude = self.home[1] + math.degrees(east / EARTH_M) / math.cos(math.radians(self.home[0]))
            place = (round(1e7 * latitude), round(1e7 * longitude), round(1e3 * (self.home[2] - down)), round(-1e3 * down))
            cm = [round(100 * each) for each in now.velocity]
            self.send(mavlink.MAVLink_attitude_message(ms, roll, pitch, yaw, *now.rate))
            self.send(mavlink.MAVLink_global_position_int_message(ms, *place, *cm, 65535))

    def obey(self, message: Any) -> None:
        pilot = self.pilot
        match message.get_type():
            case "SET_POSITION_TARGET_LOCAL_NED":
                pilot.velocity, pilot.yaw_rate = np.array([message.vx, message.vy, message.vz]), message.yaw_rate
            case "COMMAND_LONG":
                if message.command == mavlink.MAV_CMD_DO_SET_MODE:
                    pilot.mode, self.beat_s = "commanded", 0.0
                elif message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                    pilot.armed, self.beat_s = message.param1 == 1, 0.0
                elif message.command == mavlink.MAV_CMD_NAV_TAKEOFF:
                    pilot.rise_to = message.param7
                self.send(mavlink.MAVLink_command_ack_message(message.command, 0))


def ardupilot(port: int, pilot: Pilot, ground: Ground | None, stop_s: float) -> None:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.settimeout(1.0)
    outputs, frame, now = [0.0] * 4, 0, State()
    while now.time_s < stop_s:
        pulses = [round(1000 + 1000 * each) for each in outputs] + [0] * 12
        link.sendto(struct.pack("<HHI16H", 18458, 400, frame, *pulses), ("127.0.0.1", port))
        try:
            line = link.recv(65536)
        except (TimeoutError, ConnectionRefusedError):
            time.sleep(0.05)  # the run is not listening yet
            continue
        frame += 1
        assert line.startswith(b"\n"), line
        assert line.endswith(b"\n"), line
        got = json.loads(line)
        now.time_s, now.position, now.velocity = got["timestamp"], np.array(got["position"]), np.array(got["velocity"])
        now.q, now.rate = got["quaternion"], np.array(got["imu"]["gyro"])
        outputs = pilot.outputs(now)
        if ground is not None:
            ground.exchange(now)


def connected(port: int) -> socket.socket:
    while True:
        try:
            link = socket.create_connection(("127.0.0.1", port))
        except ConnectionRefusedError:
            time.sleep(0.01)
            continue
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link


class Truth:
    """State from HIL_STATE_QUATERNION; north and east from the first position."""

    def __init__(self) -> None:
        self.now = State()
        self.home: tuple[float, float, float] | None = None

    def take(self, message: Any) -> bool:
        """Process a message; True for the sensors' message, which ends a step."""
        now = self.now
        if message.get_type() == "HIL_SENSOR":
            now.time_s = 1e-6 * message.time_usec
            return True
        if message.get_type() == "HIL_STATE_QUATERNION":
            home = self.home = self.home or (1e-7 * message.lat, 1e-7 * message.lon, 1e-3 * message.alt)
            north = math.radians(1e-7 * message.lat - home[0]) * EARTH_M
            east = math.radians(1e-7 * message.lon - home[1]) * EARTH_M * math.cos(math.radians(home[0]))
            now.position = np.array([north, east, home[2] - 1e-3 * message.alt])
            now.velocity = 1e-2 * np.array([message.vx, message.vy, message.vz])
            now.q = message.attitude_quaternion
            now.rate = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        return False


def px4(port: int, pilot: Pilot, ground: Ground | None, stop_s: float) -> None:
    link, mav, truth, boot = connected(port), mavlink.MAVLink(None, srcSystem=1, srcComponent=1), Truth(), 20

    def send(message: Any) -> None:
        link.sendall(message.pack(mav))
        mav.seq = (mav.seq + 1) % 256

    send(mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 115, 4000, 0, 0, 0, 0, 0))
    send(mavlink.MAVLink_heartbeat_message(0, 12, 0, 0, 0, 3))
    while truth.now.time_s < stop_s and (data := link.recv(65536)):
        ends = [truth.take(message) for message in mav.parse_buffer(data) or []]
        if not any(ends) or truth.home is None:
            continue
        if boot:  # it sends no controls yet
            boot -= 1
            continue
        outputs = pilot.outputs(truth.now)
        if ground is not None:
            ground.exchange(truth.now)
        mode = 1 | (128 if pilot.armed else 0)
        send(mavlink.MAVLink_hil_actuator_controls_message(int(1e6 * truth.now.time_s), outputs + [0.0] * 12, mode, 1))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=["px4", "ardupilot"])
    parser.add_argument("--instance", type=int, default=0)
    parser.add_argument("--commanded", type=int, default=0, help="UDP port of a ground station")
    parser.add_argument("--stop", type=float, default=math.inf, help="simulated time of its end, s")
    options = parser.parse_args()
    pilot = Pilot(bool(options.commanded))
    home = {"px4": (47.397742, 8.545594, 488.0), "ardupilot": (-35.363261, 149.165230, 584.0)}[options.kind]
    ground = Ground(pilot, options.kind, options.commanded, home) if options.commanded else None
    if options.kind == "px4":
        px4(4560 + options.instance, pilot, ground, options.stop)
    else:
        ardupilot(9002 + 10 * options.instance, pilot, ground, options.stop)
    if math.isfinite(options.stop):
        sys.stdout.write("told to stop\n")
        sys.exit(3)


if __name__ == "__main__":
    main()
