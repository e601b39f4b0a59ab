"""Channels of many equal worlds at once, for broadcasts without contention: the outcomes of `Channel`, as arrays over worlds.

Each world has the random keys of its own seed, so that it gives what a `Channel` with this seed gives alone, to the last bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.link_budget import propagation_ns
from vcmvsp.netsim.channel.reception import TOO_WEAK, WORDS
from vcmvsp.netsim.channel.user_layers import is_own
from vcmvsp.netsim.interfaces.layers import (
    DELAY_SLOT,
    ERROR_SLOT,
    FADING_SLOT,
    LOSS_SLOT,
    Bools,
    Draw,
    Floats,
    Frame,
    Ints,
    Keys,
    Paths,
    SenderLinks,
    distances,
    unless_nothing,
)
from vcmvsp.netsim.interfaces.medium import Fate


class _AllLinks(SenderLinks):
    """The links of all senders of all worlds, in one row."""

    def __init__(self, keys: Keys, pair_keys: Keys) -> None:
        super().__init__(0, "", ())
        self.keys, self.pair_keys = keys, pair_keys  # in place of the cached properties


@dataclass(frozen=True)
class Broadcasts:
    """Outcomes of one message of each vehicle, in w worlds of n vehicles; rows of silent vehicles mean nothing."""

    arrival_ns: Ints  # (w, n, n - 1) by sender and receiver, in the order of vehicles; -1: lost
    rssi_dbm: Floats  # (w, n, n - 1)
    code: Ints  # (w, n, n - 1) index of the outcome in ``words``
    words: tuple[str, ...]


class SideBySide:
    """The channels of w worlds with the same n vehicles and layers.

    Args:
        channel: with the layers; nothing is sent on it.
        names: of the vehicles.
        seeds: of the worlds.

    Raises:
        ScenarioError: a layer needs a channel of its own: contention, walls, shadowing, bodies, traces, jammers, ...
    """

    def __init__(self, channel: Channel, names: tuple[str, ...], seeds: Sequence[int]) -> None:
        self._channel, n = channel, len(names)
        budgets, layers = channel.budgets, channel.operated.layers
        self._loss, self._delay = unless_nothing(layers["loss"]), unless_nothing(layers["delay"])
        self._propagates = getattr(layers["delay"], "propagation", False)
        why = channel.unbatchable
        for layer in (channel.fading, self._loss, self._delay):
            if not why and layer is not None and is_own(type(layer)):
                why = f"{type(layer).__name__} is a layer of your own"
        if why:
            raise ScenarioError(f"{why}: only one world at a time can have it", key="radio")
        self._words = (*WORDS, *(() if self._loss is None else (self._loss.cause,)))
        self._others = np.nonzero(~np.eye(n, dtype=np.bool_))[1].reshape(n, n - 1)
        self._raised = budgets.antennas_above(names)
        gain_dbi = budgets.gain_dbi(names)
        self._power_dbm = (budgets.tx_power_dbm(names) + gain_dbi)[:, None] + gain_dbi[self._others]
        self._sensitivity_dbm = budgets.sensitivity_dbm(names)[self._others]
        links = [SenderLinks(seed, own, names[:row] + names[row + 1 :]) for seed in seeds for row, own in enumerate(names)]
        self._shape = len(seeds), n, n - 1
        keys = pair_keys = np.concatenate([each.keys for each in links])
        uses_pairs = getattr(channel.fading, "doppler_hz", None) is not None
        self._by_time = uses_pairs or (self._loss is not None and not hasattr(self._loss, "lost_by"))
        if uses_pairs:
            pair_keys = np.concatenate([each.pair_keys for each in links])
        self._links = _AllLinks(keys, pair_keys)
        self._numbers = np.zeros(self._shape[:2], np.uint64)  # frames that each vehicle has sent
        self._free_ns = np.zeros(self._shape[:2], np.int64)

    def send(self, now_ns: int, sends: Bools, position: Floats, size_bytes: int) -> Broadcasts:
        """Broadcast a message of each of the vehicles that send, (w, n); positions (w, n, 3) m, world."""
        channel, hearing = self._channel, self._channel.hearing
        antennas = position + self._raised
        distance_m = distances(antennas[:, :, None], antennas[:, self._others])
        loss: Any = channel.budgets.path_loss
        mean_dbm = self._power_dbm - loss.loss_db(distance_m)
        start_ns = np.maximum(now_ns, self._free_ns)
        end_ns = start_ns + channel.phy.air_time_ns(size_bytes)
        level_dbm = mean_dbm
        if channel.fading is not None:
            frame = self._frame(now_ns, start_ns, size_bytes, mean_dbm)
            level_dbm = mean_dbm + channel.fading.gain_db(frame, self._draw(FADING_SLOT)).reshape(self._shape)
        signal = hearing.signal(level_dbm, self._sensitivity_dbm, size_bytes)
        code = signal.fate.astype(np.int64)
        if signal.hazard is not None and (doubtful := signal.doubtful)[0].size:
            keys, numbers = self._links.keys.reshape(self._shape)[doubtful], self._numbers[doubtful[:2]]
            patience = -np.log1p(-link_uniform(keys, numbers, ERROR_SLOT)[:, 0])
            code[doubtful] = np.where(patience <= signal.hazard[doubtful], int(Fate.ERROR), code[doubtful])
        least_dbm = np.maximum(self._sensitivity_dbm, hearing.noise_dbm + hearing.preamble_db)
        fades = np.where(mean_dbm >= least_dbm, WORDS.index("fading"), int(TOO_WEAK))
        code = np.where(code == Fate.UNDETECTED, fades, code)
        frame = self._frame(now_ns, start_ns, size_bytes, level_dbm)
        if self._loss is not None:
            lost = self._loss.lost(frame, self._draw(LOSS_SLOT)).reshape(self._shape)
            code = np.where((code == 0) & lost, len(WORDS), code)
        arrival_ns = np.broadcast_to(end_ns[..., None], self._shape)
        if self._propagates:
            arrival_ns = arrival_ns + propagation_ns(distance_m)
        if self._delay is not None:
            delay_ns = self._delay.delay_ns(frame, self._draw(DELAY_SLOT)).reshape(self._shape)
            arrival_ns = np.maximum(now_ns + delay_ns, arrival_ns)
        self._numbers += sends
        self._free_ns = np.where(sends, end_ns, self._free_ns)
        return Broadcasts(np.where(code, -1, arrival_ns), level_dbm, code, self._words)

    def _draw(self, slot: int) -> Draw:
        keys, numbers = self._links.keys.reshape(self._shape), self._numbers[..., None]
        return lambda: link_uniform(keys, numbers, slot).reshape(-1, 2)

    def _frame(self, sent_ns: int, start_ns: Ints, size_bytes: int, level_dbm: Floats) -> Frame:
        """All frames as one with many receivers; with queues the layers see the start of the first one."""
        first_ns = int(start_ns.min())
        if self._by_time and int(start_ns.max()) != first_ns:
            raise ScenarioError(
                "frames wait in queues, and this layer depends on time: send less often, or use one world at a time"
            )
        nowhere = Paths(np.zeros(3), np.zeros((0, 3)), np.zeros(0))
        return Frame(sent_ns, first_ns, first_ns, size_bytes, nowhere, level_dbm.ravel(), self._links)
