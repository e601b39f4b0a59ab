"""Emulated ROS 2 robot."""
