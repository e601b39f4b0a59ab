"""Fit of the radio to a measured log, with the walls of a scenario as obstacles, or with its rays."""

from typing import Any

from vcmvsp.cosim.assembly import radio, worlds
from vcmvsp.cosim.scenario import loader
from vcmvsp.netsim.calibration.fit import calibrate_file, figure_data, fit, fit_rays
from vcmvsp.netsim.calibration.result import Calibration, RayCalibration
from vcmvsp.netsim.propagation.rays.loss import Rays
from vcmvsp.physics.raycast.line_of_sight import Sightline


def sightline_of(scenario: str) -> Sightline:
    """Line-of-sight test against the solids of a scenario's world."""
    parsed, source = loader.load(scenario)
    world, _ = worlds.build(parsed.world, source, seed=parsed.seed)
    return Sightline(world.solids)


def rays_of(scenario: str) -> tuple[Rays, dict[str, Any]]:
    """The rays of a scenario's radio, and their table.

    Raises:
        ScenarioError: its path loss is another.
    """
    parsed, source = loader.load(scenario)
    world, _ = worlds.build(parsed.world, source, seed=parsed.seed)
    channel, _, resolved = radio.channel_of(parsed, source, solids=world.solids)
    rays = channel.budgets.path_loss
    if not isinstance(rays, Rays):
        raise source.error("--rays needs path_loss.kind = 'rays'", "radio.path_loss.kind")
    return rays, resolved["path_loss"]
