"""Followers on the ground, consensus."""
