"""Pure Aloha: a radio sends each frame at once, also while others send; a duty cycle keeps it silent afterwards."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec

from vcmvsp.netsim.interfaces.layers import Keys, Phy
from vcmvsp.netsim.interfaces.medium import Medium
from vcmvsp.netsim.mac.blind import BlindEvent, BlindMedium, BlindRadio


class AlohaRadio(BlindRadio):
    """The queue of one radio, and the time from which it may send again."""

    free_ns = 0


class AlohaMedium(BlindMedium[AlohaRadio]):
    """The `netsim.interfaces.medium.Medium` of pure Aloha."""

    def __init__(self, rules: "Aloha", phy: Phy, radios: Sequence[AlohaRadio], noise_mw: float) -> None:
        super().__init__(rules.queue_frames, phy, radios, noise_mw)
        self._duty_cycle = rules.duty_cycle

    def _await_turn(self, now_ns: int, radio: AlohaRadio) -> None:
        radio.is_busy = True
        self._schedule(max(now_ns, radio.free_ns), BlindEvent.TURN, radio)

    def _take_turn(self, now_ns: int, radio: AlohaRadio, turn: int) -> None:
        super()._take_turn(now_ns, radio, turn)
        radio.free_ns = now_ns + math.ceil((self._frames[radio.row].end_ns - now_ns) / self._duty_cycle)


@dataclass(frozen=True)
class Aloha:
    """Pure Aloha: no carrier sense, no acknowledgements. Collisions are those of `netsim.mac.blind`.

    Without capture and with Poisson traffic of G frames per air time, a share exp(-2 G) of the frames survives (N. Abramson,
    The ALOHA System, AFIPS 1970).
    """

    duty_cycle: Annotated[float, msgspec.Meta(gt=0, le=1)] = 1.0  # a frame of T is followed by silence of T / duty_cycle - T
    queue_frames: Annotated[int, msgspec.Meta(ge=1)] | None = None  # at a sender, with the frame on the air; None: no limit

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The medium of ``count`` radios."""
        return AlohaMedium(self, phy, [AlohaRadio(row) for row in range(count)], noise_mw)
