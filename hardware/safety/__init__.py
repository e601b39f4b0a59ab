"""Safety between a command and a real robot, the last step before its driver. No driver, link or process belongs here.

`supervisor` has parameters, limits, time-outs and the control step, `obstacles` has fence and other vehicles;
`ground_supervisor` is for robots with two driven wheels, `aerial_supervisor` for what flies.
"""
