"""Autopilot firmware in the loop: programs of ArduPilot, PX4 and Betaflight fly simulated quadrotors, in step with the run.

`link` is what all kinds share, `ardupilot`, `px4` and `betaflight` are the protocols, `lock_step` exchanges readings for rotor
speeds and handles lost firmware. `commander` passes commands of agents on as MAVLink set-points, `pilot` as sticks of a remote
control. `private_network` starts a program whose ports are fixed. Physics calls `LockStepFirmware` through
`cosim.federate.FlightFirmware`. Real autopilots are in `hardware.drivers.mavlink`.
"""
