"""Robots with their own computer, where `vcmvsp robot` runs; `ZenohDriver` is the driver in the run, over Eclipse Zenoh.

Both sides share only `messages`.
"""
