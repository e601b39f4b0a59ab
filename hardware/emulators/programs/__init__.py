"""Emulated devices at the pace of the wall clock, for rehearsals without hardware: robots at a port, and tags.

`robot` serves a robot of `hardware.drivers.arcos`, which drives on an empty floor or, by `scenario`, in the world of a
scenario; `positioning` says where it truly is, with the errors of a positioning system. `options` reads what a command line
says.
"""
