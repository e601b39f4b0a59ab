"""Emulated devices at the pace of the wall clock, as programs (`vcmvsp emulate`) and within a run. No protocol belongs here.

`arcos` serves a robot, which drives on an empty floor or, by `scenario`, in the world of a scenario; `mavlink` and `ros2` serve
the others; `in_run` takes the place of a vehicle's robot; `options` reads the command line.
"""
