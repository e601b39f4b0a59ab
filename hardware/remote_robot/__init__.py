"""Robots with a computer aboard: there `vcmvsp robot` drives, here `ZenohDriver` is the driver, Eclipse Zenoh lies between.

Only `messages` is shared by the two sides.
"""
