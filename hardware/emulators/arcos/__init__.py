"""Emulated ARCOS robot: a state machine without clock (`device`), served at a port. No driver belongs here."""
