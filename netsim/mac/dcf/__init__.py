"""IEEE 802.11 DCF: backoff, carrier sense, preamble detection, capture, retries. Arrays and loops: the core is compiled."""
