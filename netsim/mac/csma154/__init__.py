"""IEEE 802.15.4 unslotted CSMA/CA."""
