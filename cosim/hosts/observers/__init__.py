"""Observers of a run from elsewhere: watching it, and checking that it can be reached. An observer never changes a run."""
