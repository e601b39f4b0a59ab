"""Figures of formations: circles, steps, delay, loss, chains, consensus."""
