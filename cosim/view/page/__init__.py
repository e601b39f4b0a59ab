"""The page in the browser: scene, charts, panels, controls.

A function of the messages of `cosim.view.messages`: no run, recording or socket.
"""
