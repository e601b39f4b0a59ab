"""Emulated devices, for rehearsals without hardware and for tests of drivers. Drivers do not import them."""
