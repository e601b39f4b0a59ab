"""Figures of search: shared maps, recognition, reconnaissance. No algorithm: those are `agents.reconnaissance`."""
