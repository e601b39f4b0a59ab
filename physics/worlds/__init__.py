"""Worlds that a scenario can name: each has ``build() -> World``. Readers of files are in `physics.importers`."""
