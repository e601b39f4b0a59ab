"""Motion of vehicles and movable bodies. What sensors see of it does not belong here."""
