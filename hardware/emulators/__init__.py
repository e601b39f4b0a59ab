"""Emulated devices for rehearsals without hardware."""
