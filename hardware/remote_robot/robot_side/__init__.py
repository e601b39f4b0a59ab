"""The program on the robot. Nothing of a run is imported here."""
