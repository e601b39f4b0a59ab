"""Curves of the channel's models: packet errors by SNR, mean levels by distance."""

from vcmvsp.netsim.evaluation.model_curves import error_rate, grid, mean_levels, packet_errors

__all__ = ["error_rate", "grid", "mean_levels", "packet_errors"]
