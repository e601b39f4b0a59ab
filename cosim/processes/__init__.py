"""Processes of this machine: child processes, local links, a pool of workers."""
