"""Emulated positioning tags."""
