"""Trained policies as agents: ``agent = { kind = "vcmvsp.policy:Policy", file = "policy.npz" }``."""

from vcmvsp.cosim.learning.policy import META, Network, Policy, PolicyMeta, load_network, meta_of, save_network

__all__ = ["META", "Network", "Policy", "PolicyMeta", "load_network", "meta_of", "save_network"]
