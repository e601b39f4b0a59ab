"""Scenario files: tables, loading, expansion."""
