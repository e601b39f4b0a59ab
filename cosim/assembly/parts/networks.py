"""Networks of runs on this machine, one namespace per vehicle (`netsim.bridge.gateways.ip.run_networks`); Linux only."""

from vcmvsp.netsim.bridge.gateways.ip.namespaces import missing
from vcmvsp.netsim.bridge.gateways.ip.run_networks import (
    RunNetwork,
    Space,
    become,
    caller,
    check_free,
    clear,
    networks,
    run_inside,
)
from vcmvsp.netsim.bridge.process_client import BridgeClient


def leave_root() -> None:
    """Switch to the user who called sudo, if any; only the process that makes the interfaces keeps root's rights."""
    if (user := caller()) is not None:
        BridgeClient.prepare()
        become(user)
