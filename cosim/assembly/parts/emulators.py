"""Emulated robots and positioning tags, served at a real port until interrupted."""

from functools import partial

from vcmvsp.hardware.emulators.arcos.program import RobotOptions, Tags, circle_of, emulate_tag, faults_of, port_of, tags_of
from vcmvsp.hardware.emulators.arcos.program import emulate as emulate_robot
from vcmvsp.hardware.emulators.arcos.scenario import emulate
from vcmvsp.hardware.emulators.device_server import Ready, duration_of
from vcmvsp.physics.vehicles.specification import flies

emulate_vehicle = partial(emulate, flies=flies)
"""Serves an emulated robot that drives in the world of a scenario (`hardware.emulators.arcos.scenario.emulate`)."""
