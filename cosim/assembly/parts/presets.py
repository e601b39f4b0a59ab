"""Named radio channels and the layers of a channel; light to import."""

from vcmvsp.netsim.presets import LAYERS, PRESETS, preset
