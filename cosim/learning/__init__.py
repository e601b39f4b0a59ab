"""Learning over the emulated radio: tasks, environments for trainers, and trained policies as agents."""
