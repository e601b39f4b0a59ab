"""Scenario files: tables, loading, expansion. Nothing is built from them here, and no part is known."""
