"""Robots that run ROS 2, reached over Eclipse Zenoh by `rmw_zenoh` or by a bridge from DDS; no ROS 2 is needed on this side.

The emulated robot is in `hardware.emulators.ros2`.
"""
