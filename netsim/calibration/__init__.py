"""Channel parameters from measured links. No drawing, no files but the log that is read."""
