"""Published figures and laws, measured again: figures and validation."""
