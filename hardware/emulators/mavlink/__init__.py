"""Emulated MAVLink vehicle: a state machine without clock (`vehicle`), served over UDP or TCP. No driver belongs here."""
