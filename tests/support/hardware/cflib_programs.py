"""Programs of Crazyflie users, by cflib; run as ``PROGRAM URI...``, so that its licence stays apart.

Each prints a line of JSON: mostly the logged positions (x, y, z in m) of each aircraft, by time.
"""

import json
import logging
import math
import sys
import threading
import time
from typing import Any

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import CompressedSegment, CompressedStart, MemoryElement, Poly4D
from cflib.crazyflie.swarm import CachedCfFactory, Swarm
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.positioning.motion_commander import MotionCommander

SIDE_M, POLY4D_BYTES = 0.2, 132


class Log:
    """Newest position, m, and its time, s, by the aircraft's own clock: a simulation may be slower than the wall clock."""

    def __init__(self, scf: SyncCrazyflie) -> None:
        self.time_s, self.place = -math.inf, list[float]()
        self._news = threading.Condition()
        block = LogConfig("place", 20)
        for axis in "xyz":
            block.add_variable(f"stateEstimate.{axis}", "float")
        block.data_received_cb.add_callback(self._take)
        scf.cf.log.add_config(block)
        block.start()
        self.place_after(0.0)

    def _take(self, time_ms: int, values: dict[str, float], block: LogConfig) -> None:
        with self._news:
            self.time_s, self.place = 1e-3 * time_ms, [values[f"stateEstimate.{axis}"] for axis in "xyz"]
            self._news.notify()

    def place_after(self, seconds: float) -> list[float]:
        """Position after some time."""
        with self._news:
            end_s = self.time_s + seconds
            if not self._news.wait_for(lambda: self.time_s >= max(end_s, 0.0), timeout=60.0):
                raise RuntimeError("no log")
            return self.place


def square(scf: SyncCrazyflie) -> tuple[list[tuple[float, list[float]]], float]:
    """Positions at the corners of a square, flown by velocities, and the duration of each side, s; wanted height, m."""
    log = Log(scf)
    with MotionCommander(scf, default_height=0.3) as motion:
        corners = [(0.0, log.place_after(1.0))]
        for side in (motion.forward, motion.left, motion.back, motion.right):
            begin_s = log.time_s
            side(SIDE_M)
            flown_s = log.time_s - begin_s
            corners.append((flown_s, log.place_after(0.5)))
        return corners, motion._thread.get_height()


def go_to(scf: SyncCrazyflie) -> list[list[float]]:
    """Positions after take-off, after a flight by the high-level commander, and after landing."""
    log = Log(scf)
    x, y, _ = log.place
    commander, places = scf.cf.high_level_commander, []
    commander.takeoff(0.4, 1.0)
    places.append(log.place_after(2.0))
    commander.go_to(x + 0.4, y + 0.6, 0.8, 0.0, 1.5)
    places.append(log.place_after(2.5))
    commander.land(0.02, 1.5)
    places.append(log.place_after(2.0))
    commander.stop()
    return places


def trajectories(scf: SyncCrazyflie) -> list[list[float]]:
    """Positions before and after an uploaded trajectory, and after a compressed one behind it in the memory."""
    (memory,) = scf.cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
    log, commander = Log(scf), scf.cf.high_level_commander
    memory.trajectory = [Poly4D(2.0, y=Poly4D.Poly([0.0, 0.0, 0.3, -0.1, 0.0, 0.0, 0.0, 0.0]))]  # 0.4 m, from rest to rest
    memory.write_data_sync()
    commander.define_trajectory(1, 0, 1)
    segment = CompressedSegment(2.0, [0.0, -0.4, -0.4], [], [0.0, 0.3, 0.3], [])
    memory.trajectory = [CompressedStart(0.0, 0.0, 0.0, 0.0), segment]
    memory.write_data_sync(start_addr=POLY4D_BYTES)
    commander.define_trajectory(2, POLY4D_BYTES, 2, type=commander.TRAJECTORY_TYPE_POLY4D_COMPRESSED)
    commander.takeoff(0.5, 1.5)
    places = [log.place_after(2.0)]
    for number in (1, 2):
        commander.start_trajectory(number, relative_position=True)
        places.append(log.place_after(2.5))
    commander.stop()
    return places


def tables(scf: SyncCrazyflie) -> dict[str, Any]:
    """Tables of contents of a connection: variables, parameters, and a changed one."""
    scf.wait_for_params()
    param = scf.cf.param
    param.set_value("kalman.initialX", 1.5)
    time.sleep(0.5)
    return {
        "log": sorted(f"{group}.{name}" for group, own in scf.cf.log.toc.toc.items() for name in own),
        "param": {f"{group}.{name}": value for group, own in param.values.items() for name, value in own.items()},
    }


PROGRAMS = {"square": square, "go_to": go_to, "tables": tables, "trajectories": trajectories}


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
