"""Programs that drive simulated vehicles in place of agents (`cosim.federate.Stack`): ROS 2 nodes, programs of cflib.

Firmware, which drives the rotors of quadrotors, is in `hardware.firmware`.
"""
