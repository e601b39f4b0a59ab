"""Emulated tags of positioning systems. Readers of real ones are in `hardware.localisation`."""
