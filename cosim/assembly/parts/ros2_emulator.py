"""Emulated ROS 2 robot, served at a Zenoh endpoint until interrupted; loads Zenoh and ROS messages."""

from vcmvsp.hardware.emulators.ros2 import emulate
