"""The command line `vcmvsp`: one module for each group of commands."""
