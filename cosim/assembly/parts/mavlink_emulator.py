"""Emulated vehicle with an autopilot, served at a real port until interrupted; loads MAVLink."""

from vcmvsp.hardware.emulators.mavlink.server import emulate
