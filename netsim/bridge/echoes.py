"""What agents say, told apart from what programs say: agents hear both under one key, and programs have the latter anyway."""

from collections import Counter

from vcmvsp.cosim.types import Reception, Traffic
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge.process import messages


class Echoes:
    """Datagrams on their way to agents, who hear them as bytes; all times in the run's."""

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self._vehicles = vehicles
        self._said: dict[int, tuple[str, bytes]] = {}  # by number: by whom, and what
        self._coming: Counter[tuple[str, int, str, bytes]] = Counter()  # receiver, when, sender, what

    def said(self, came: messages.Came) -> None:
        """These were given to the radio, with their bytes."""
        for number, sender, payload in zip(came.number.tolist(), came.sender.tolist(), came.payloads, strict=True):
            self._said[number] = self._vehicles[sender], payload

    def decided(self, traffic: Traffic) -> None:
        """These will be heard."""
        rows = zip(traffic.number.tolist(), traffic.receiver.tolist(), traffic.arrival_ns.tolist(), strict=True)
        for number, receiver, received_ns in rows:
            sender, payload = self._said[number]
            if payload:  # nobody hears nothing
                self._coming[self._vehicles[receiver], received_ns, sender, payload] += 1
        for number in traffic.settled.tolist():
            del self._said[number]

    def by_agent(self, vehicle: str, heard: Reception) -> bytes | None:
        """What an agent said, as programs are given it; None: this is what a program said."""
        body = heard.message.body
        if not isinstance(body, bytes):
            return encode(body)
        echo = vehicle, heard.received_ns, heard.message.sender, body
        if echo not in self._coming:
            return body
        self._coming[echo] -= 1
        if not self._coming[echo]:
            del self._coming[echo]
        return None
