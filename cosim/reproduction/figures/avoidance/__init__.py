"""Figures of obstacle avoidance: potential fields, gaps, passages."""
