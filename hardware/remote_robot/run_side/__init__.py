"""The driver in the run: admission of robots and the session with one. No driver of the robot's own is imported here."""
