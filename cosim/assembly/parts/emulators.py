"""Emulated devices, served at a real port until they are interrupted: robots, and tags of positioning systems."""

from functools import partial

from vcmvsp.hardware.emulators.programs.arcos import Ready, emulate_tag
from vcmvsp.hardware.emulators.programs.arcos import emulate as emulate_robot
from vcmvsp.hardware.emulators.programs.options import Tags, circle_of, duration_of, robot_options, tags_of
from vcmvsp.hardware.emulators.programs.scenario import emulate
from vcmvsp.physics.vehicles.specification import flies

__all__ = [
    "Ready",
    "Tags",
    "circle_of",
    "duration_of",
    "emulate_robot",
    "emulate_tag",
    "emulate_vehicle",
    "robot_options",
    "tags_of",
]

emulate_vehicle = partial(emulate, flies=flies)
"""Serves an emulated robot that drives in the world of a scenario (`hardware.emulators.programs.scenario.emulate`)."""
