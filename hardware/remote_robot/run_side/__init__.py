"""Driver and session in the run."""
