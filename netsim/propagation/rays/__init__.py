"""Site-specific propagation: paths of the wave among the solids of the world, by images and the uniform theory of diffraction.

Start with `loss` (the layers), then `tracer` (from two points to paths), `field` (from paths to gains). Not here: statistical
models, which know distances only (`netsim.propagation`).
"""
