"""At which level an attempt to send a frame reaches each receiver, and what that alone makes of it."""

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.frames import FrameBatch, SentFrame
from vcmvsp.netsim.channel.mean_budget import ReceivedSignal
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import Fading
from vcmvsp.netsim.interfaces.link_draws import ACK_FADING_SLOT, ERROR_SLOT, FADING_SLOT, RETRY_FADING_SLOT, SCRIPT_SLOT
from vcmvsp.netsim.interfaces.medium import Codes, Fate


class RxPower:
    """The layers that give each attempt a level of its own; None is one that does nothing."""

    def __init__(self, fading: Fading | None, script: Script | None, trace: Trace | None) -> None:
        self._fading, self._script, self._trace = fading, script, trace
        self.vary = any(layer is not None for layer in (fading, script, trace))  # from attempt to attempt

    def set(self, sent: SentFrame, start_ns: int) -> None:
        """Set the level of an attempt that begins at ``start_ns``, where it is another one than the mean."""
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

        It fades as another frame at its own time: with the Doppler shift as far as the channel has changed since, else
        independently. A traced level holds for both.
        """
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        is_traced = self._trace is not None and not np.isnan(self._trace.level_dbm(frame)[place])
        if self._fading is None or sent.fading_db is None or is_traced:
            return 1.0
        gain_db = self._fading.gain_db(frame, sent.draw(ACK_FADING_SLOT + sent.attempts))
        return float(10.0 ** ((gain_db[place] - sent.fading_db[place]) / 10.0))


def endured(sent: SentFrame, heard: ReceivedSignal) -> Codes:
    """The fate of a frame that no other disturbs, (n,)."""
    fate, doubtful = heard.fate, heard.doubtful
    if doubtful.size and heard.hazard is not None:
        uniform = sent.sender.draws.some(sent.number, ERROR_SLOT, doubtful)[:, 0]
        fate = fate.copy()
        fate[doubtful[-np.log1p(-uniform) <= heard.hazard[doubtful]]] = Fate.ERROR
    return fate


def all_endured(chorus: FrameBatch) -> Codes:
    """The same of several frames, (k, n)."""
    fate, hazard = chorus.heard.fate, chorus.heard.hazard
    if hazard is None or not (where := chorus.heard.in_doubt.nonzero())[0].size:
        return fate
    keys = np.stack([sender.links.keys for sender in chorus.senders])[where]
    uniform = link_uniform(keys, np.array(chorus.numbers, np.uint64)[where[0]], ERROR_SLOT)[:, 0]
    lost = -np.log1p(-uniform) <= hazard[where]
    fate = fate.copy()
    fate[where[0][lost], where[1][lost]] = Fate.ERROR
    return fate
