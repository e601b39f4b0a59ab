"""Station of a real vehicle: a process of its own that runs driver, localisation, fusion and safety at a constant rate.

A run, which may wait for an agent, hang or be killed, sends orders and takes reports. The station does what must not wait: it
stops the robot when orders stay away, when the position is lost, at the fence, and on ``vcmvsp stop``. Protocols of robots
and rules of safety do not belong here.
"""
