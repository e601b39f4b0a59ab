"""Followers on the ground and their control laws, consensus among them. Membership and reports are in packages beside it."""
