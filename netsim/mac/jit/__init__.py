"""Compilation of the core of DCF to machine code, with its cache; no radio model in here."""
