"""ARCOS, the serial protocol of Pioneer and AmigoBot robots. The emulated robot is in `hardware.emulators.arcos`."""
