"""Emulated devices, to rehearse without hardware and to test drivers against. Drivers do not import them."""
