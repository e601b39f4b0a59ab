"""Emulated MAVLink vehicle."""
