"""An emulated vehicle with an autopilot, served at a real port until it is interrupted; loads MAVLink."""

from vcmvsp.hardware.emulators.mavlink.server import emulate

__all__ = ["emulate"]
