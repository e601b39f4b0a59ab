"""The network layer, between messages and frames: messages reach those whom their sender's radio does not reach, over others.

Start reading at `netsim.routing.network`. What a kind of routing decides, and how one of your own looks, is in
`netsim.routing.router`. Nothing of links: whether a frame arrives is up to `netsim.channel`.
"""
