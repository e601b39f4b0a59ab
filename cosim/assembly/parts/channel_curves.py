"""Curves of the channel's models, packet errors by SNR and mean levels by distance; its coverage of places."""

from vcmvsp.netsim.evaluation import coverage
from vcmvsp.netsim.evaluation.model_curves import error_rate, grid, mean_levels, packet_errors

__all__ = ["coverage", "error_rate", "grid", "mean_levels", "packet_errors"]
