"""A node of zenoh-ros2-sdk; it shares only Zenoh with this project, and its message definitions are those of rosbags.

It drives one vehicle to a place by ``odom`` and ``scan``, answers each ``odom`` with one command, and sends a counter by
radio. As a program, ``PORT VEHICLE X Y [OPTIONS]``: it prints each radio reception on a line, and ends with its input.
"""

import argparse
import math
import os
import sys
from typing import Any

import msgspec
import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber

STORE = get_typestore(Stores.ROS2_JAZZY)
OWN = {  # as on the user's page
    "vcmvsp_msgs/msg/RadioSend": "string to\nbool msgpack\nuint8[] data\n",
    "vcmvsp_msgs/msg/RadioReceived": "std_msgs/Header header\nstring sender\nfloat64 rssi_dbm\n"
    "builtin_interfaces/Duration age\nbool msgpack\nuint8[] data\n",
}
for name, text in OWN.items():
    STORE.register(get_types_from_msg(text, name))


def definition(kind: str) -> dict[str, str]:
    """Text and hash of a type, without a download."""
    return {"msg_definition": STORE.generate_msgdef(kind)[0], "type_hash": STORE.hash_rihs01(kind)}


class Driver:
    """Drives to (x, y); ``silent_after``: number of observations that it answers; ``report``: it sends reports to followers."""

    def __init__(
        self,
        port: int,
        vehicle: str,
        x: float,
        y: float,
        *,
        stamped: bool = False,
        silent_after: int = 10**9,
        report: bool = False,
    ) -> None:
        self.goal, self.stamped, self.left = (x, y), stamped, silent_after
        self.nearest_m, self.count, self.reports = math.inf, 0, report
        at: dict[str, Any] = {"router_port": port}
        kind = "geometry_msgs/msg/TwistStamped" if stamped else "geometry_msgs/msg/Twist"
        send, received = OWN
        self._subscribed = [
            ROS2Subscriber(f"/{vehicle}/{topic}", name, hear, **definition(name), **at)
            for topic, name, hear in (
                ("scan", "sensor_msgs/msg/LaserScan", self.on_scan),
                ("radio/received", received, self.on_radio),
                ("odom", "nav_msgs/msg/Odometry", self.on_odometry),
            )
        ]
        self._send = ROS2Publisher(f"/{vehicle}/radio/send", send, **definition(send), **at)
        self._twist = ROS2Publisher(f"/{vehicle}/cmd_vel", kind, **definition(kind), **at)  # last: lock-step begins with it

    def on_scan(self, scan: Any) -> None:
        self.nearest_m = float(min(each for each in scan.ranges if each >= scan.range_min))

    def on_radio(self, message: Any) -> None:
        age_s = message.age.sec + 1e-9 * message.age.nanosec
        sys.stdout.write(f"{message.sender} {message.data.tobytes().hex()} {message.rssi_dbm:.6f} {age_s:.9f}\n")
        sys.stdout.flush()

    def on_odometry(self, odometry: Any) -> None:
        self.left -= 1
        if self.left < 0:
            return
        place, turn, types = odometry.pose.pose.position, odometry.pose.pose.orientation, self._twist.session_mgr.store.types
        yaw = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2))
        dx, dy = self.goal[0] - place.x, self.goal[1] - place.y
        off = math.remainder(math.atan2(dy, dx) - yaw, math.tau)
        v = 0.0 if self.nearest_m < 0.4 else min(0.5, math.hypot(dx, dy)) * max(0.0, math.cos(off))
        vector, twist = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Twist"]
        command = {"linear": vector(v, 0.0, 0.0), "angular": vector(0.0, 0.0, off if math.hypot(dx, dy) > 0.1 else 0.0)}
        self.count += 1
        content = self.count.to_bytes(4, "big")
        if self.reports:
            t_ns = odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec
            w = command["angular"].z
            report = {"seq": self.count, "t_ns": t_ns, "x": place.x, "y": place.y, "th": yaw, "v": v, "w": w}
            content = msgspec.msgpack.encode(report)
        self._send.publish(to="", msgpack=self.reports, data=np.frombuffer(content, np.uint8))
        if self.stamped:
            self._twist.publish(header=odometry.header, twist=twist(**command))
        else:
            self._twist.publish(**command)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("vehicle")
    parser.add_argument("x", type=float)
    parser.add_argument("y", type=float)
    parser.add_argument("--stamped", action="store_true")
    parser.add_argument("--silent-after", type=int, default=10**9)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    driver = Driver(**vars(options))
    sys.stdin.read()
    os._exit(0)  # the SDK's session does not end
