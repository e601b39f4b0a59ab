"""Protocol of a physics engine, commands to it, contacts from it."""
