"""The core of VCMVSP: time, scenarios, agents, recordings, studies, and the command line."""

if __name__ != "vcmvsp.cosim":
    raise ImportError(f"this is vcmvsp.cosim: import it by that name, not as '{__name__}'")
