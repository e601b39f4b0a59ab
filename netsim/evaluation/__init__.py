"""The channel without a run: broadcast trials, model curves, coverage. No model, and no part of a run."""
