"""Figures of formations: circles, steps, delay, loss, chains, consensus. No control law: those are `agents.formation`."""
