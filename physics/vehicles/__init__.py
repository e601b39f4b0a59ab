"""Vehicle models and their parameters."""
