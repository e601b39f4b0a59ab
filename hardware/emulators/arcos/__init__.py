"""Emulated ARCOS robot: a state machine without clock (`device`, `motion`), served at a port. No driver belongs here."""
