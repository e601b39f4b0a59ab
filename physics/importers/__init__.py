"""Worlds read from files; like those of `physics.worlds`, each has ``build() -> World``. Nothing here makes up a world."""
