"""An emulated robot that runs ROS 2, served at a Zenoh endpoint until it is interrupted; loads Zenoh and ROS messages."""

from vcmvsp.hardware.emulators.ros2 import emulate

__all__ = ["emulate"]
