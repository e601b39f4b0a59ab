"""The station of a real vehicle: a process of its own, in which driver, localisation, fusion and safety turn at a steady rate.

A run, which may wait for an agent, hang or be killed, sends it orders and takes its reports. What must not wait happens here:
the robot is stopped when orders stay away, when its position is lost, at the fence, and when somebody calls ``vcmvsp stop``.
Protocols of robots and rules of safety do not belong here.
"""
