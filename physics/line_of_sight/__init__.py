"""Solids between two points."""
