"""Leader reports: content, prediction, when sent, what was received."""
