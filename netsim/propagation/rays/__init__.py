"""Site-specific propagation: the paths of a wave among the solids of the world, by image method and uniform theory of diffraction.

Start with `loss` (the layers), then `tracer` (from two points to paths), `field` (from paths to gains). Not here: statistical
models, which know distances only (`netsim.propagation`).
"""
