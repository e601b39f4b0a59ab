"""Messages as vectors: the newest one that each vehicle has from each other one."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.learning.task import AGE_BOUND_S, LEAST_DBM, Floats
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.types import Message, Receptions


class Mail:
    """The newest message that each of n vehicles has from each other one, in w worlds.

    Attributes:
        message: (w, n, n - 1, m), in the order of vehicles.
        sent_ns: (w, n, n - 1); -1: none yet.
        rssi_dbm: (w, n, n - 1).
    """

    def __init__(self, worlds: int, vehicles: int, floats: int) -> None:
        shape = worlds, vehicles, vehicles - 1
        self.message = np.zeros((*shape, floats))
        self.sent_ns = np.full(shape, -1, np.int64)
        self.rssi_dbm = np.full(shape, LEAST_DBM)

    def put_received(self, received: ReceivedMessages, receiver: int, row: Mapping[str, int]) -> None:
        """Take the messages of one vehicle, whose row is ``receiver``."""
        for sender, reception in received.latest_by_sender().items():
            at = 0, receiver, row[sender] - (row[sender] > receiver)
            if reception.sent_ns >= self.sent_ns[at]:
                self.message[at] = vectors_of([reception.message], self.message.shape[-1])[0]
                self.sent_ns[at], self.rssi_dbm[at] = reception.sent_ns, reception.rssi_dbm

    def put(self, batch: Receptions, row: Mapping[str, int]) -> None:
        """Take messages of one world, in order of arrival at each receiver: of a pair the one that was sent last counts."""
        senders = np.array([row[message.sender] for message in batch.messages])[batch.message]
        sent_ns, receivers = batch.sent_ns[batch.message], batch.receiver
        place = senders - (senders > receivers)
        order = np.argsort(sent_ns, kind="stable")  # of equal times the later arrival comes last, and is kept
        order = order[sent_ns[order] >= self.sent_ns[0, receivers[order], place[order]]]
        at = 0, receivers[order], place[order]
        self.message[at] = vectors_of(batch.messages, self.message.shape[-1])[batch.message[order]]
        self.sent_ns[at] = sent_ns[order]
        self.rssi_dbm[at] = batch.rssi_dbm[order]

    def take(self, now_ns: int, sent_ns: int, message: Floats, arrival_ns: NDArray[np.int64], rssi_dbm: Floats) -> None:
        """Take what arrives by now of the messages (w, n, m) that all vehicles sent at one time, unless a newer one is known.

        Args:
            arrival_ns, rssi_dbm: (w, n, n - 1) by sender and receiver; -1: lost.
        """
        sender, receiver_place, receiver, sender_place = _transposed(arrival_ns.shape[1])
        arrived = (arrival_ns >= 0) & (arrival_ns <= now_ns)
        newer = arrived[:, sender, receiver_place] & (self.sent_ns[:, receiver, sender_place] <= sent_ns)
        world, pair = np.nonzero(newer)
        at = world, receiver[pair], sender_place[pair]
        self.message[at] = message[world, sender[pair]]
        self.sent_ns[at] = sent_ns
        self.rssi_dbm[at] = rssi_dbm[world, sender[pair], receiver_place[pair]]

    def ages(self, now_ns: int) -> dict[str, NDArray[Any]]:
        """Fields of `Worlds` at a time."""
        heard = self.sent_ns >= 0
        age_s = np.where(heard, (now_ns - self.sent_ns) / 1e9, AGE_BOUND_S)
        return {"message": self.message, "rssi_dbm": self.rssi_dbm, "age_s": age_s, "heard": heard}


def vectors_of(messages: Sequence[Message], floats: int) -> Floats:
    """Numbers of messages in [-1, 1], (k, floats): of bytes as float32, of a mapping by keys; the rest is 0."""
    size = 4 * floats
    bodies = [_packed(message.body)[:size].ljust(size, b"\0") for message in messages]
    whole = np.frombuffer(b"".join(bodies), "<f4").reshape(-1, floats)
    return np.minimum(np.maximum(np.where(np.isfinite(whole), whole, 0.0), -1.0), 1.0).astype(float)


def _packed(body: Mapping[str, Any] | bytes) -> bytes:
    if isinstance(body, bytes):
        return body
    numbers = [body[key] for key in sorted(body) if isinstance(body[key], int | float)]
    return np.array(numbers, "<f4").tobytes()


@functools.lru_cache
def _transposed(vehicles: int) -> tuple[NDArray[np.intp], ...]:
    """All pairs: row of the sender, the receiver's place among its others, row of the receiver, the sender's place there."""
    sender, receiver = np.nonzero(~np.eye(vehicles, dtype=bool))
    return sender, receiver - (receiver > sender), receiver, sender - (sender > receiver)
