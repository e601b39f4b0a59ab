"""Real robots in a run: the protocol of their drivers, drivers, and robots in software to try them on."""
