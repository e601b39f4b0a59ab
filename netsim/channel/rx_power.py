"""Received level of each attempt to send a frame, and decoding without interference."""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.frames import SentFrame
from vcmvsp.netsim.channel.mean_budget import ReceivedSignal
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import Fading
from vcmvsp.netsim.interfaces.link_draws import ACK_FADING_SLOT, ERROR_SLOT, FADING_SLOT, RETRY_FADING_SLOT, SCRIPT_SLOT
from vcmvsp.netsim.interfaces.medium import Codes, Fate


class RxPower:
    """The layers that change the level of each attempt; None: no such layer."""

    def __init__(self, fading: Fading | None, script: Script | None, trace: Trace | None) -> None:
        self._fading, self._script, self._trace = fading, script, trace
        self.vary = any(layer is not None for layer in (fading, script, trace))  # whether levels change from attempt to attempt

    def set(self, sent: SentFrame, start_ns: int) -> None:
        """Set the level of an attempt that starts at ``start_ns``."""
        if not self.vary:
            return
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        level_dbm = sent.mean.level_dbm
        if self._fading is not None:
            slot = RETRY_FADING_SLOT + sent.attempts if sent.attempts > 1 else FADING_SLOT
            sent.fading_db = self._fading.gain_db(frame, sent.draw(slot))
            level_dbm = level_dbm + sent.fading_db
        if self._trace is not None:
            traced_dbm = self._trace.level_dbm(frame)
            level_dbm = np.where(np.isnan(traced_dbm), level_dbm, traced_dbm)
        if self._script is not None:
            level_dbm = level_dbm + self._script.gain_db(frame, sent.draw(SCRIPT_SLOT))
        sent.level_dbm = level_dbm

    def answer(self, sent: SentFrame, place: int, start_ns: int) -> float:
        """Fading of an acknowledgement from the receiver at ``place`` over that of the frame, a ratio of powers.

        It fades as a frame of its own time: correlated with a Doppler shift, else independent. A traced level holds for both.
        """
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        is_traced = self._trace is not None and not np.isnan(self._trace.level_dbm(frame)[place])
        if self._fading is None or sent.fading_db is None or is_traced:
            return 1.0
        gain_db = self._fading.gain_db(frame, sent.draw(ACK_FADING_SLOT + sent.attempts))
        return float(10.0 ** ((gain_db[place] - sent.fading_db[place]) / 10.0))


def decode(frames: Sequence[SentFrame], signal: ReceivedSignal) -> Codes:
    """Fate of k frames without interference, (k, n); ``signal``: (k, n)."""
    rows, places = signal.doubtful
    if not rows.size or signal.hazard is None:
        return signal.fate
    keys = np.stack([sent.sender.links.keys for sent in frames])[rows, places]
    numbers = np.array([sent.number for sent in frames], np.uint64)[rows]
    patience = -np.log1p(-link_uniform(keys, numbers, ERROR_SLOT)[:, 0])
    lost = patience <= signal.hazard[rows, places]
    fate = signal.fate.copy()
    fate[rows[lost], places[lost]] = Fate.ERROR
    return fate
