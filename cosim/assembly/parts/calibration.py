"""Fit of the radio to a measured log, with the walls of a scenario as obstacles."""

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.scenario import loader
from vcmvsp.netsim.calibration.fit import calibrate_file, figure_data
from vcmvsp.netsim.calibration.result import Calibration
from vcmvsp.physics.raycast.line_of_sight import Sightline


def sightline_of(scenario: str) -> Sightline:
    """Line-of-sight test against the solids of a scenario's world."""
    parsed, source = loader.load(scenario)
    world, _ = worlds.build(parsed.world, source, seed=parsed.seed)
    return Sightline(world.solids)
