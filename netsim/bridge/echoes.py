"""Separates messages of agents from datagrams of programs: both are receptions under one key."""

from collections import Counter

from vcmvsp.cosim.types import Reception, Traffic
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge.process import messages


class Echoes:
    """Datagrams of programs on their way to agents; times of the run."""

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self._vehicles = vehicles
        self._sent: dict[int, tuple[str, bytes]] = {}  # by number: sender, payload
        self._coming: Counter[tuple[str, int, str, bytes]] = Counter()  # receiver, time, sender, payload

    def sent(self, batch: messages.NewDatagrams) -> None:
        """Note datagrams that enter the radio."""
        for number, sender, payload in zip(batch.number.tolist(), batch.sender.tolist(), batch.payloads, strict=True):
            self._sent[number] = self._vehicles[sender], payload

    def decided(self, traffic: Traffic) -> None:
        """Note their deliveries."""
        rows = zip(traffic.number.tolist(), traffic.receiver.tolist(), traffic.arrival_ns.tolist(), strict=True)
        for number, receiver, received_ns in rows:
            sender, payload = self._sent[number]
            if payload:  # an empty payload causes no reception
                self._coming[self._vehicles[receiver], received_ns, sender, payload] += 1
        for number in traffic.settled.tolist():
            del self._sent[number]

    def agent_payload(self, vehicle: str, reception: Reception) -> bytes | None:
        """Payload for programs if an agent sent the message; None for a datagram of a program."""
        body = reception.message.body
        if not isinstance(body, bytes):
            return encode(body)
        echo = vehicle, reception.received_ns, reception.message.sender, body
        if echo not in self._coming:
            return body
        self._coming[echo] -= 1
        if not self._coming[echo]:
            del self._coming[echo]
        return None
