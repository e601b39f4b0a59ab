"""Paths of rays beside Sionna RT, between the same places among the same buildings. ``python -m bench.rays``, two minutes.

CPU seconds of each process, for all links once; the tests compare the paths themselves.
"""

import itertools
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from bench.asked import SilentError, installed, program
from bench.measure import Row, cpu, in_turn, missing, table
from bench.peers.sionna_paths import FREQUENCY_HZ, REFLECTIONS
from vcmvsp.cosim.scenario import loader
from vcmvsp.netsim.propagation.rays.loss import Rays
from vcmvsp.physics.raycast.mitsuba_scene import files
from vcmvsp.physics.raycast.surfaces import SolidSurfaces
from vcmvsp.physics.world.solids import Box

PYTHON = Path(".sionna/bin/python")
STREETS = [  # x, y m in relay-canyon: along its three streets
    *zip((-40.0, -10.0, 20.0, 45.0), itertools.repeat(1.0)),
    *zip(itertools.repeat(60.0), (2.0, 20.0, 45.0, 70.0)),
    *zip((61.0, 80.0, 110.0, 140.0), itertools.repeat(81.0)),
]
GROUND, MOST, ROUNDS = "medium_dry_ground", 0.01, 1


def rows() -> list[Row]:
    """One row."""
    print("measuring: rays, beside Sionna RT ...", file=sys.stderr, flush=True)
    boxes = loader.table_of(loader.path_of("relay-canyon"))["world"]["boxes"]
    solids = [Box(**box) for box in boxes]
    rays = Rays(SolidSurfaces(solids), frequency_hz=FREQUENCY_HZ, reflections=REFLECTIONS, ground=GROUND, transmission=False)
    rays.prepare()
    points = [(x, y, 1.5) for x, y in STREETS]
    links = np.array(list(itertools.combinations(points, 2)))
    name = f"paths of {len(links)} links in relay-canyon, two reflections and diffraction; beside Sionna RT 2.2 (LLVM)"
    demand = f"<= {MOST:g}"
    with tempfile.TemporaryDirectory() as folder:
        for file, text in files(solids, rays.slab_m, GROUND).items():
            Path(folder, file).write_text(text, "utf-8")
        Path(folder, "points.json").write_text(json.dumps(points))
        try:
            with program("sionna_paths", installed(PYTHON), at=folder) as peer_stretch:
                ours, other, ratio = in_turn(
                    lambda: cpu(lambda: rays.traced(links[:, 0].copy(), links[:, 1].copy())), peer_stretch, ROUNDS
                )
        except SilentError as error:
            return [missing(name, demand, error)]
    cost, its_cost = f"{1e3 * ours / len(links):.2f} CPU ms a link", f"{1e3 * other / len(links):.0f}"
    return [Row(name, cost, its_cost, ratio, demand, ratio <= MOST)]


if __name__ == "__main__":
    print(table(rows()))
