"""Figures of obstacle avoidance: potential fields, gaps, passages. No method: those are `agents.avoidance`."""
