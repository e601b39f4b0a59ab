"""Entry points for external programs."""
