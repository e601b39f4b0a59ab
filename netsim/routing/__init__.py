"""The network layer, between messages and frames: multi-hop delivery of messages.

Start reading at `netsim.routing.network`; the protocol of routing kinds is in `netsim.routing.router`. Nothing of links:
whether a frame arrives is decided in `netsim.channel`.
"""
