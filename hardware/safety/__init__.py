"""Safety between a command and a real robot, the last step before its driver. No driver, link or process belongs here.

`supervisor` has parameters, limits, time-outs, the control step and the supervisor of robots with two driven wheels;
`aerial_supervisor` is for what flies; `obstacles` has fence and other vehicles.
"""
