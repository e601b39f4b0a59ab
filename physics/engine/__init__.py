"""Protocol of a physics engine, commands to it, contacts from it. Engines themselves are in `physics.dynamics`."""
