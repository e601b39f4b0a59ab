"""Figures of search: shared maps, recognition, reconnaissance."""
