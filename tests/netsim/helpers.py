"""Channels, positions and frames in one line each."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.types import FrameReport, Message
from netsim.channel import Channel
from netsim.delay import FixedDelay, NoDelay
from netsim.layers import Frame, Paths
from netsim.loss import Bernoulli, NoLoss
from netsim.phy import ConstantRate, Dsss, Ieee802154
from netsim.presets import preset
from netsim.propagation import LogDistance, NoPathLoss

KINDS: dict[str, dict[str, Callable[..., Any]]] = {
    "path_loss": {"none": NoPathLoss, "log_distance": LogDistance},
    "phy": {"constant_rate": ConstantRate, "dsss": Dsss, "ieee802154": Ieee802154},
    "loss": {"none": NoLoss, "bernoulli": Bernoulli},
    "delay": {"none": NoDelay, "fixed": FixedDelay},
}


def make_channel(name: str = "ideal", *, seed: int = 1, **changes: dict[str, Any]) -> Channel:
    """A channel of a preset: ``make_channel("wifi-b-1", seed=3, loss={"probability": 0.2})``."""
    layers = preset(name)
    for layer, change in changes.items():
        layers[layer] = {**({} if "kind" in change else layers[layer]), **change}
    built = {layer: KINDS[layer][table.pop("kind")](**table) for layer, table in layers.items()}
    channel = Channel(**built)
    channel.start(seed)
    return channel


def send(channel: Channel, *distances: float, sent_ns: int = 0, size_bytes: int = 100, to: str | None = None) -> FrameReport:
    """One frame of car0, which is at the origin, to car1, car2, ... at these distances along the x axis."""
    names = ("car0", *(f"car{i + 1}" for i in range(len(distances))))
    position = np.array([(0.0, 0.0, 0.0), *((d, 0.0, 0.0) for d in distances)])
    message = Message(sender="car0", body={}, size_bytes=size_bytes, to=to)
    return channel.transmit(sent_ns, message, names, position)


def make_frame(*shape: int) -> Frame:
    """A frame with a level array of the given shape, for asking a layer directly."""
    nowhere: NDArray[np.float64] = np.zeros((1, 3))
    return Frame(0, 0, 1_000_000, 100, Paths.between(nowhere[0], nowhere), np.zeros(shape))
