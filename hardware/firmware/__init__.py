"""Autopilot firmware in the loop: programs of ArduPilot and PX4 fly simulated quadrotors, in lock-step with the run.

`link` is what all kinds share, `ardupilot` and `px4` are the protocols, `lock_step` exchanges readings for rotor speeds and
handles lost firmware, `commander` passes commands of agents on as MAVLink set-points. Physics calls `LockStepFirmware` through
`cosim.federate.FlightFirmware`. Real autopilots are in `hardware.drivers.mavlink`.
"""
