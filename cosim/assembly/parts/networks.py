"""Networks of runs on this machine, a namespace for each vehicle (`netsim.bridge.gateways.ip.run_networks`); Linux only."""

from vcmvsp.netsim.bridge.gateways.ip.namespaces import missing
from vcmvsp.netsim.bridge.gateways.ip.run_networks import Network, check_free, clear, networks, run_inside

__all__ = ["Network", "check_free", "clear", "missing", "networks", "run_inside"]
