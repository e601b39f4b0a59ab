"""Emulated ARCOS robot."""
