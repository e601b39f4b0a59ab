"""Compilation of the core of DCF to machine code, with its cache. No radio model."""
