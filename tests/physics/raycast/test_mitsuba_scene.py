"""Scenes for Sionna RT: shared corners, sheets, materials; equal paths if Sionna RT is installed."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from tests.support.netsim.ray_worlds import rays_among, trace_paths
from tests.support.requirements import installed_apart
from vcmvsp.physics.raycast.mitsuba_scene import SCENE, files
from vcmvsp.physics.world.solids import Box

HOUSE = Box(center=(10.0, 10.0, 5.0), size=(10.0, 10.0, 10.0), material="brick")
WALL = Box(center=(-5.0, 0.0, 1.5), size=(0.2, 8.0, 3.0), material="glass")


def corners_of(ply: str) -> list[tuple[float, ...]]:
    head, _, rest = ply.partition("end_header\n")
    count = int(head.partition("element vertex ")[2].split()[0])
    return [tuple(map(float, line.split())) for line in rest.splitlines()[:count]]


def test_a_solid_is_a_mesh_with_shared_corners_and_a_thin_one_its_middle_plane() -> None:
    content = files([HOUSE, WALL], 0.5, "wet_ground")
    scene = ET.fromstring(content[SCENE])
    thickness = {each.get("id"): [part.get("value") for part in each] for each in scene.iter("bsdf")}
    assert list(thickness.values()) == [["brick", "10.0"], ["glass", "0.2"], ["wet_ground", "10.0"]]
    assert [shape.get("id") for shape in scene.iter("shape")] == ["solid0", "solid1", "ground"]
    house, wall = corners_of(content["solid0.ply"]), corners_of(content["solid1.ply"])
    assert len(house) == len(set(house)) == 8
    assert len(wall) == 4
    assert {corner[0] for corner in wall} == {-5.0}
    assert len(files([HOUSE, WALL], 0.5, "none")) == 3


def test_sionna_finds_equal_paths(tmp_path: Path) -> None:
    rt = installed_apart("sionna.rt")
    for name, text in files([HOUSE], 0.5, "concrete").items():
        (tmp_path / name).write_text(text, "utf-8")
    a, b = (0.0, 3.0, 1.0), (12.0, 2.0, 2.0)
    scene = rt.load_scene(str(tmp_path / SCENE), merge_shapes=False)
    scene.frequency = 2.4e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("a", position=list(a)))
    scene.add(rt.Receiver("b", position=list(b)))
    found = rt.PathSolver()(scene, max_depth=2, diffuse_reflection=False, refraction=False)
    real, imag = (np.array(part).ravel() for part in found.a)
    size, delay = np.hypot(real, imag), np.array(found.tau).ravel()
    reference = sorted(zip(delay[size > 0.0] * 1e9, 20.0 * np.log10(size[size > 0.0]), strict=True))
    table = trace_paths(rays_among(HOUSE, ground="concrete", diffraction=False), a, b).table
    ours = sorted(zip(table.length_m / 0.299792458, 20.0 * np.log10(np.abs(table.gain)), strict=True))
    assert len(ours) == len(reference)
    for own, other in zip(ours, reference, strict=True):
        assert math.dist(own, other) < 0.05
