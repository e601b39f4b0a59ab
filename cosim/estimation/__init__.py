"""Pose and clock estimation shared by simulated and real robots."""
