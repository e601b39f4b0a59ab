"""Logical time: the kernel and the event bus."""
