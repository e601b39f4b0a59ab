"""Robots with ROS 2, over Eclipse Zenoh by `rmw_zenoh` or by a bridge from DDS; this side needs no ROS 2.

The emulated robot is in `hardware.emulators.ros2`.
"""
