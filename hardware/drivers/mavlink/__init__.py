"""Vehicles with an autopilot that speaks MAVLink (PX4, ArduPilot). The emulated one is in `hardware.emulators.mavlink`."""
