"""The view of a recorded run: reading a recording by time."""
