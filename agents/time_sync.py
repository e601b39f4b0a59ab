"""Clock synchronisation over the radio, around another agent.

A vehicle asks its reference for the time; four stamps of an exchange give the offset of its clock, as in NTP (RFC 5905, clause
8) and PTP (IEEE 1588)::

    asking vehicle     t1 ----request----.                 .---> t4
    reference                             `--> t2   t3 ---reply

    offset = ((t1 - t2) + (t4 - t3)) / 2

Radios stamp messages when they are handed over and when they arrive, so ticks of agents do not count. If the request takes d1
and the reply d2, the offset is wrong by (d2 - d1) / 2: no exchange can tell asymmetric delays from an offset.

========= ====== ===========================================================
key       type   meaning
========= ====== ===========================================================
``ts``    str    ``ask`` or ``tell``
``n``     int    number of the request
``t1``    int    reply: sending of the request, ns, by the asking clock
``t2``    int    reply: arrival of the request, ns, by the reference's clock
========= ====== ===========================================================
"""

import math
from typing import Annotated, Any

import msgspec

from vcmvsp.agents.factory import build_nested
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.estimation.clock_offset import EchoClock
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.types import NonNegative, Positive, Reception, Velocity, Waypoint
from vcmvsp.cosim.vehicle_clock import timed

KEY, ASK, TELL = "ts", "ask", "tell"

Window = Annotated[int, msgspec.Meta(ge=1, le=1000)]


class TimeSync(Agent):
    """Runs another agent with the time of a reference vehicle, whose agent is a ``time_sync``, too.

    The task sees the corrected time as `Observation.clock_ns`, in its readings and in the arrivals of messages; the sendings of
    messages stay by their senders' clocks. Notes after each exchange ``clock_offset_s``, own clock minus the reference's, and
    ``clock_error_s``, its bound: half the round trip.

    Args:
        task: table of the agent that drives: its ``kind`` and its parameters.
        reference: vehicle whose time counts; default: this one, which only answers.
        ask_s: period of requests, s.
        window: number of exchanges of which the best counts: that with the least round trip.
        drift_ppm: maximum drift of the clocks against each other, for the age of an exchange.
    """

    def __init__(
        self,
        task: dict[str, Any],
        *,
        reference: str | None = None,
        ask_s: Positive = 1.0,
        window: Window = 8,
        drift_ppm: NonNegative = 100.0,
    ) -> None:
        self.task, self.reference, self.ask_s = build_nested(task, "task"), reference, ask_s
        self.period, self.sensors = self.task.period, self.task.sensors
        self._window, self._drift_ppm = window, drift_ppm

    def start(self, info: VehicleInfo) -> None:
        """Refuse a reference that is not another vehicle; start the task."""
        if self.reference is not None and (self.reference == info.name or self.reference not in info.vehicles):
            others = ", ".join(name for name in info.vehicles if name != info.name) or "none"
            raise ValueError(f"reference = {self.reference!r} is not another vehicle of this run; other vehicles: {others}")
        self._echoes = EchoClock(window=self._window, drift_ppm=self._drift_ppm)
        self._number, self._ask_at_s = 0, -math.inf
        self.task.start(info)
        self.follows = self.task.follows

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """The command of the task, which sees the time of the reference."""
        own = []
        for reception in obs.heard:
            body = reception.message.body
            if isinstance(body, dict) and KEY in body:
                own.append(reception)
                self._take(reception, body, radio)
        if self.reference is not None and obs.time_s >= self._ask_at_s:
            self._ask_at_s = obs.time_s + self.ask_s
            self._number += 1
            radio.send({KEY: ASK, "n": self._number}, to=self.reference)
        command = self.task.act(self._corrected(obs, own), radio)
        self.follows = self.task.follows
        self.note(**self.task.drain_notes())
        for value in self.task.drain_shown().values():
            self.show(value)
        return command

    def close(self) -> None:
        """Close the task."""
        self.task.close()

    def _take(self, reception: Reception, body: dict[str, Any], radio: Radio) -> None:
        """Answer a request, or use the reply to the newest one."""
        message, number = reception.message, body.get("n")
        if self.reference is None and body[KEY] == ASK and type(number) is int:
            reply = {KEY: TELL, "n": number, "t1": reception.sent_ns, "t2": reception.received_ns}
            radio.send(reply, to=message.sender)
        elif message.sender == self.reference and body[KEY] == TELL and number == self._number:
            asked_ns, arrived_ns = body.get("t1"), body.get("t2")
            if type(asked_ns) is int and type(arrived_ns) is int:
                self._echoes.add(asked_ns, arrived_ns, reception.sent_ns, reception.received_ns)
                self._note_offset(reception.received_ns)

    def _note_offset(self, now_ns: int) -> None:
        best = self._echoes.best(now_ns)
        if best is not None:
            self.note(clock_offset_s=best.offset_ns / 1e9, clock_error_s=best.error_ns / 1e9)

    def _corrected(self, obs: Observation, own: list[Reception]) -> Observation:
        """The observation by the reference's time, without the messages of this agent."""
        best = self._echoes.best(obs.clock_ns)
        offset_ns = 0 if best is None else best.offset_ns
        if not own and not offset_ns:
            return obs
        own_ns, messages = obs.clock_ns - offset_ns, obs.heard
        if len(messages):
            others = [each for each in messages if each not in own]
            moved = [msgspec.structs.replace(each, received_ns=each.received_ns - offset_ns) for each in others]
            messages = ReceivedMessages.of(moved, own_ns)
        newest = dict.items(obs.readings)  # without computing those on demand
        readings = {name: timed(reading, lambda time_ns: time_ns - offset_ns) for name, reading in newest}
        return msgspec.structs.replace(obs, own_time_ns=own_ns, heard=messages, readings=type(obs.readings)(readings))
