"""Drivers: what a run needs of a real robot."""
