"""Vehicles with an autopilot that speaks MAVLink (PX4, ArduPilot): the driver, and an emulated vehicle to test it against.

Start reading in `hardware.drivers.mavlink.driver`. Frames are converted in `frames` alone, bytes become messages in `codec`
alone.
"""
