"""Medium access: who sends when, and which frames collide. Nothing of levels, which `netsim.channel` gives."""
