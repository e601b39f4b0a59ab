"""Vehicles with an autopilot that speaks MAVLink (PX4, ArduPilot). The emulated one is in `hardware.emulators.mavlink`.

Start reading in `driver`. Coordinates are converted in `coordinate_frames` alone, bytes become messages in `codec` alone.
"""
