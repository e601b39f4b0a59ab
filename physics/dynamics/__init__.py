"""How vehicles and movable bodies move."""
