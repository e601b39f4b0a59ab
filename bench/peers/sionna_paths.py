"""Sionna RT (github.com/NVlabs/sionna-rt): all paths between points of a scene, by its LLVM backend on the CPU.

``--at FOLDER``: with ``scene.xml`` and ``points.json``. Each pair once; enough rays a source to find the paths of two
reflections, and of diffraction, in streets.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path

from bench.peers.pace import Options, stretches

FREQUENCY_HZ, REFLECTIONS, RAYS = 2.437e9, 2, 2_000_000
LLVM = sorted(Path("/usr/lib").glob("*-linux-gnu/libLLVM*.so*"), key=lambda path: path.name.rpartition("LLVM")[2])


def links(settings: Options) -> Callable[[], None]:
    """The scene; each call finds the paths of all links."""
    newest = next((path for path in reversed(LLVM) if ".so.19" in path.name or "-15" in path.name), None)
    if newest is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(newest))
    import mitsuba  # type: ignore[import-not-found]

    mitsuba.set_variant("llvm_ad_mono_polarized")
    from sionna import rt  # type: ignore[import-not-found]

    scene = rt.load_scene(str(Path(settings.at, "scene.xml")), merge_shapes=False)
    scene.frequency = FREQUENCY_HZ
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    points = json.loads(Path(settings.at, "points.json").read_text())
    solver = rt.PathSolver()

    def find() -> None:
        for first, place in enumerate(points[:-1]):
            scene.add(rt.Transmitter("sender", position=place))
            names = [f"receiver{number}" for number in range(first + 1, len(points))]
            for name, there in zip(names, points[first + 1 :], strict=True):
                scene.add(rt.Receiver(name, position=there))
            paths = solver(
                scene,
                max_depth=REFLECTIONS,
                diffuse_reflection=False,
                refraction=False,
                diffraction=True,
                edge_diffraction=False,
                diffraction_lit_region=True,
                samples_per_src=RAYS,
            )
            paths.cir(normalize_delays=False, out_type="numpy")
            for name in ("sender", *names):
                scene.remove(name)

    return find


if __name__ == "__main__":
    stretches(links)
