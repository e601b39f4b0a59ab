"""When a vehicle that others follow tells them where it is: what ``sending = {...}`` of an agent says, and who does it."""

from collections.abc import Sequence
from typing import Any, Literal

import msgspec

from agents.formation.report import send_report
from cosim.agent import Observation, Radio
from cosim.types import Positive


class Sending(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When reports are sent."""

    when: Literal["always", "needed"] = "always"  # at every tick, or once those who follow would be wrong by the threshold
    threshold: Positive = 0.02  # of "needed": m; an error of the heading counts half a metre a radian
    silence_s: Positive = 2.0  # of "needed": it sends at least so often, s
    acknowledge: bool = True  # of "needed": followers confirm what they hear, and it is sent again until they do


class Reporter:
    """Sends the reports of one vehicle."""

    def __init__(self, sending: Sending | None = None) -> None:
        self.sending = sending or Sending()
        self._seq = 0

    def start(self, listeners: Sequence[str]) -> None:
        """Before the first tick: who is going to follow this vehicle (whose acknowledgements are awaited)."""

    def tell(self, radio: Radio, obs: Observation, v: float, w: float, **more: Any) -> None:
        """At every tick: speeds from now on, m/s and rad/s, and what else belongs into the report; sent if it is due."""
        send_report(radio, self._seq, obs, v, w, **more)
        self._seq += 1
