"""IEEE 802.15.4 unslotted CSMA/CA, acknowledgements and retries, as state machines. No beacons, nothing of networks above."""
