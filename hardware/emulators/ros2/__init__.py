"""Emulated ROS 2 robot. Messages and keys are those of `hardware.drivers.ros2`."""
