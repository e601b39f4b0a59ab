"""Programs of cflib, as a user of Crazyflies writes them; run as one, ``PROGRAM URI...``, so that its licence stays apart.

Each prints a line of JSON: the logged places (x, y, z in m) of each aircraft, by time.
"""

import json
import logging
import sys
import time
from typing import Any

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.swarm import CachedCfFactory, Swarm
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger
from cflib.positioning.motion_commander import MotionCommander

SIDE_M = 0.5


def place_of(scf: SyncCrazyflie) -> list[float]:
    """Logged place, m."""
    block = LogConfig("place", 20)
    for axis in "xyz":
        block.add_variable(f"stateEstimate.{axis}", "float")
    with SyncLogger(scf, block) as logger:
        for _, values, _ in logger:
            return [values[f"stateEstimate.{axis}"] for axis in "xyz"]
    raise RuntimeError("no log")


def square(scf: SyncCrazyflie) -> list[list[float]]:
    """Places at the corners of a square, flown by velocities."""
    with MotionCommander(scf, default_height=0.5) as motion:
        time.sleep(1.0)
        places = [place_of(scf)]
        for side in (motion.forward, motion.left, motion.back, motion.right):
            side(SIDE_M)
            time.sleep(0.5)
            places.append(place_of(scf))
    return places


def go_to(scf: SyncCrazyflie) -> list[list[float]]:
    """Places after take-off, after a way by the high-level commander, and after landing."""
    x, y, _ = place_of(scf)
    commander, places = scf.cf.high_level_commander, []
    commander.takeoff(0.6, 1.5)
    time.sleep(2.5)
    places.append(place_of(scf))
    commander.go_to(x + 0.4, y + 0.6, 1.0, 0.0, 2.0)
    time.sleep(3.0)
    places.append(place_of(scf))
    commander.land(0.02, 2.0)
    time.sleep(2.5)
    places.append(place_of(scf))
    commander.stop()
    return places


def tables(scf: SyncCrazyflie) -> dict[str, Any]:
    """What a connection brings: variables, parameters, and a changed one."""
    scf.wait_for_params()
    param = scf.cf.param
    param.set_value("kalman.initialX", 1.5)
    time.sleep(0.5)
    return {
        "log": sorted(f"{group}.{name}" for group, own in scf.cf.log.toc.toc.items() for name in own),
        "param": {f"{group}.{name}": value for group, own in param.values.items() for name, value in own.items()},
    }


PROGRAMS = {"square": square, "go_to": go_to, "tables": tables}


def main(name: str, *uris: str) -> None:
    """Run a program on one aircraft, or on all of a swarm at once."""
    logging.basicConfig(level=logging.ERROR)
    cflib.crtp.init_drivers()
    found: dict[str, Any] = {}

    def run(scf: SyncCrazyflie) -> None:
        found[scf.cf.link_uri] = PROGRAMS[name](scf)

    if len(uris) == 1:
        with SyncCrazyflie(uris[0], cf=Crazyflie(rw_cache=None)) as scf:
            run(scf)
    else:
        with Swarm(uris, factory=CachedCfFactory()) as swarm:
            swarm.parallel_safe(run)
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
