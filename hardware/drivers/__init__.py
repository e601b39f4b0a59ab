"""Drivers of real robots, behind one protocol (`base`). Runs, safety rules and localisation do not belong here."""
