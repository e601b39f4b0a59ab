"""Pose and clock estimation shared by simulated and real robots.

Functions of measurements and times: no sensor, driver, socket or wall clock.
"""
