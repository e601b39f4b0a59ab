"""The emulated radio: which frames arrive where, how strong, and when. Nothing of physics, agents or hardware."""

if __name__ != "vcmvsp.netsim":
    raise ImportError(f"this is vcmvsp.netsim: import it by that name, not as '{__name__}'")
