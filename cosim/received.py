"""Messages on their way to agents: `Mailboxes` hold them until a tick, `ReceivedMessages` are those of one tick of one agent.

Receptions travel as columns (`cosim.types.Receptions`). A `Reception` with its own copy of the body is made only when an agent
looks at it.
"""

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, overload

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, Reception, Receptions
from vcmvsp.cosim.vehicle_clock import VehicleClocks

_MUTABLE = frozenset({dict, list})  # types that MessagePack decodes to


class ReceivedMessages(Sequence[Reception]):
    """Messages that a vehicle has received since its last tick, in order of arrival: a sequence of `Reception`.

    Items are made when they are looked at; the columns need no items. Each item has its own copy of the message's body.

    Attributes:
        now_ns: the tick, by the vehicle's clock.
    """

    def __init__(self, batch: "_SortedBatch", begin: int, end: int, now_ns: int) -> None:
        self._batch, self._begin, self._end, self.now_ns = batch, begin, end, now_ns
        self._items: dict[int, Reception] = {}

    @classmethod
    def of(cls, receptions: Iterable[Reception], now_ns: int) -> "ReceivedMessages":
        """The sequence of given items, which are not copied."""
        items = list(receptions)
        received = cls(_SortedBatch(receptions_at("", items, ("",))), 0, len(items), now_ns)
        received._items = dict(enumerate(items))
        return received

    @classmethod
    def none(cls, now_ns: int) -> "ReceivedMessages":
        """No messages."""
        return cls(_NOTHING, 0, 0, now_ns)

    def __len__(self) -> int:
        return self._end - self._begin

    @overload
    def __getitem__(self, place: int) -> Reception: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Reception, ...]: ...

    def __getitem__(self, place: int | slice) -> Reception | tuple[Reception, ...]:
        if isinstance(place, slice):
            return tuple(self._all()[place])
        return self._item(range(self._begin, self._end)[place])

    def __iter__(self) -> Iterator[Reception]:
        return iter(self._all())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]  # bodies are mutable

    def __repr__(self) -> str:
        return f"ReceivedMessages({list(self)!r})"

    @property
    def senders(self) -> tuple[str, ...]:
        """Sender of each message, (n,)."""
        messages = self._batch.columns.messages
        return tuple([messages[number].sender for number in self._batch.numbers[self._begin : self._end]])

    def of_senders(self, senders: Collection[str]) -> list[Reception]:
        """The messages of some senders."""
        return [self._item(row) for row, sender in enumerate(self.senders, self._begin) if sender in senders]

    def bodies(self, senders: Collection[str] | None = None) -> list[tuple[str, dict[str, Any]]]:
        """Sender and own copy of the body of the messages of agents: of some senders, or of all."""
        batch, bodies = self._batch, []
        for number in batch.numbers[self._begin : self._end]:
            message = batch.columns.messages[number]
            if (senders is None or message.sender in senders) and not isinstance(message.body, bytes):
                bodies.append((message.sender, batch.body(number)))
        return bodies

    @property
    def rssi_dbm(self) -> Array:
        """Received signal strength, (n,) dBm."""
        return self._batch.columns.rssi_dbm[self._begin : self._end]

    @property
    def sent_ns(self) -> Array:
        """Time of sending by the sender's clock, (n,) ns."""
        columns = self._batch.columns
        return columns.sent_ns[columns.message[self._begin : self._end]]

    @property
    def received_ns(self) -> Array:
        """Time of arrival by the receiver's clock, (n,) ns."""
        return self._batch.columns.arrival_ns[self._begin : self._end]

    @property
    def age_s(self) -> Array:
        """Time since each message was sent, by both clocks, (n,) s."""
        return (self.now_ns - self.sent_ns) / 1e9

    def latest_by_sender(self) -> dict[str, Reception]:
        """The message of each sender that was sent last, in order of the senders' first arrivals.

        Of two that were sent at the same time, it is the later arrival.
        """
        sent_ns = self.sent_ns.tolist()
        latest: dict[str, int] = {}
        for place, sender in enumerate(self.senders):
            if sender not in latest or sent_ns[place] >= sent_ns[latest[sender]]:
                latest[sender] = place
        return {sender: self._item(self._begin + place) for sender, place in latest.items()}

    def _item(self, row: int) -> Reception:
        """The item of a row of the batch, always the same object."""
        item = self._items.get(row)
        if item is None:
            item = self._items[row] = self._batch.reception(row)
        return item

    def _all(self) -> list[Reception]:
        return [self._item(row) for row in range(self._begin, self._end)]


class _SortedBatch:
    """Receptions by receiver, then arrival; what items and bodies need is made at the first look.

    Attributes:
        numbers: message of each reception, (m,).
    """

    def __init__(self, columns: Receptions) -> None:
        self.columns = columns
        self.numbers: list[int] = columns.message.tolist()
        self._copiers: dict[int, Callable[[], Any]] = {}  # by message
        self._sent_ns: list[int] = []
        self._rssi_dbm: list[float] = []
        self._arrival_ns: list[int] = []

    def body(self, number: int) -> Any:
        """A copy of the body of a message: an agent that changes it does not affect other receivers."""
        copier = self._copiers.get(number)
        if copier is None:
            copier = self._copiers[number] = _copier(self.columns.messages[number].body)
        return copier()

    def reception(self, row: int) -> Reception:
        """A reception with its own copy of the body."""
        if not self._rssi_dbm:
            columns = self.columns
            self._sent_ns, self._rssi_dbm = columns.sent_ns.tolist(), columns.rssi_dbm.tolist()
            self._arrival_ns = columns.arrival_ns.tolist()
        number = self.numbers[row]
        sent = self.columns.messages[number]
        message = msgspec.structs.replace(sent, body=self.body(number))
        return Reception(
            message=message, rssi_dbm=self._rssi_dbm[row], sent_ns=self._sent_ns[number], received_ns=self._arrival_ns[row]
        )


def _copier(body: dict[str, Any] | bytes) -> Callable[[], Any]:
    if isinstance(body, bytes):
        return body.__bytes__  # itself
    if _MUTABLE.isdisjoint(map(type, body.values())):
        return body.copy
    return partial(msgspec.msgpack.decode, msgspec.msgpack.encode(body))


class Mailboxes:
    """Receptions that some vehicles have not taken yet."""

    def __init__(self, names: Sequence[str], vehicles: Collection[str], clocks: VehicleClocks | None = None) -> None:
        """Open a mailbox for each of ``vehicles``.

        Args:
            names: all vehicles, in the order of rows in batches.
            clocks: of the vehicles, for the times that `open` gives; None: the time of the run.
        """
        self._clocks = clocks
        self._row = {name: row for row, name in enumerate(names)}
        self._vehicles = frozenset(vehicles)
        self._owned = None if len(self._vehicles) == len(names) else self._mask(vehicles)
        self._waiting: list[tuple[int, Receptions]] = []  # with the earliest arrival, ns

    def put(self, batch: Receptions) -> None:
        """Add the receptions of the owners of these mailboxes."""
        owned = None if self._owned is None else self._owned[batch.receiver]
        if owned is not None and not owned.all():
            batch = _rows_of(batch, owned)
        if len(batch.receiver):
            self._waiting.append((int(batch.arrival_ns.min()), batch))

    def take(self, now_ns: int, vehicles: Collection[str] | None = None) -> Receptions | None:
        """Take what has arrived by now at these vehicles (None: at all), by receiver and arrival; None: nothing.

        Receptions of equal arrival stay in the order of `put`.
        """
        waiting = self._waiting
        begun = len(waiting)  # behind the last batch of which something has arrived
        while begun and waiting[begun - 1][0] > now_ns:
            begun -= 1
        if not begun:
            return None
        batch = _joined([each for _, each in waiting[:begun]])
        is_taken = batch.arrival_ns <= now_ns
        if vehicles is not None and len(vehicles) < len(self._vehicles):
            is_taken &= self._mask(vehicles)[batch.receiver]
        count = np.count_nonzero(is_taken)
        if count == len(is_taken):
            self._waiting = waiting[begun:]
        else:
            rest = pruned(_rows_of(batch, ~is_taken))
            self._waiting = [(int(rest.arrival_ns.min()), rest), *waiting[begun:]]
            if not count:
                return None
            batch = _rows_of(batch, is_taken)
        if not np.count_nonzero(batch.receiver[1:] <= batch.receiver[:-1]):  # one message to each at most, in order
            return batch
        receiver = batch.receiver.astype(np.uint16) if len(self._row) < 1 << 16 else batch.receiver  # sorted by digits
        return _rows_of(batch, np.lexsort((batch.arrival_ns, receiver)))

    def open(self, now_ns: int, vehicles: Collection[str] | None = None) -> dict[str, ReceivedMessages]:
        """What `take` takes, by vehicle, with the times of the vehicles' clocks."""
        return self.by_receiver(self.take(now_ns, vehicles), now_ns)

    def by_receiver(self, batch: Receptions | None, now_ns: int) -> dict[str, ReceivedMessages]:
        """What `take` has taken, by vehicle, with the times of the vehicles' clocks."""
        if batch is None:
            return {}
        clocks = self._clocks
        batch = batch if clocks is None else clocks.stamped(batch)
        sorted_batch, names, messages, begin = _SortedBatch(batch), batch.names, dict[str, ReceivedMessages](), 0
        for row, count in enumerate(np.bincount(batch.receiver).tolist()):
            if count:
                own_ns = now_ns if clocks is None else clocks.reading_ns(names[row], now_ns)
                messages[names[row]] = ReceivedMessages(sorted_batch, begin, begin + count, own_ns)
                begin += count
        return messages

    def _mask(self, vehicles: Collection[str]) -> Array:
        mask = np.zeros(len(self._row), np.bool_)
        mask[[self._row[name] for name in vehicles]] = True
        return mask


def _rows_of(batch: Receptions, rows: Array) -> Receptions:
    """Some receptions of a batch, by number or by mask; all of its messages."""
    return msgspec.structs.replace(
        batch,
        message=batch.message[rows],
        receiver=batch.receiver[rows],
        arrival_ns=batch.arrival_ns[rows],
        rssi_dbm=batch.rssi_dbm[rows],
    )


def pruned(batch: Receptions) -> Receptions:
    """The batch without messages that it has no reception of."""
    if len(batch.messages) == 1:
        return batch
    used = np.zeros(len(batch.messages), np.bool_)
    used[batch.message] = True
    numbers = np.flatnonzero(used).tolist()
    return msgspec.structs.replace(
        batch,
        messages=tuple([batch.messages[number] for number in numbers]),
        sent_ns=batch.sent_ns[numbers],
        message=(np.cumsum(used) - 1)[batch.message],
    )


def _joined(batches: Sequence[Receptions]) -> Receptions:
    """The receptions of batches of one run, in order."""
    if len(batches) == 1:
        return batches[0]
    first = itertools.accumulate((len(each.messages) for each in batches[:-1]), initial=0)
    numbers = [each.message + offset for each, offset in zip(batches, first, strict=True)]
    messages = itertools.chain.from_iterable(each.messages for each in batches)
    columns = {}
    for name in ("sent_ns", "receiver", "arrival_ns", "rssi_dbm"):
        columns[name] = np.concatenate([getattr(each, name) for each in batches])
    return Receptions(names=batches[0].names, messages=tuple(messages), message=np.concatenate(numbers), **columns)


def receptions_at(vehicle: str, items: Sequence[Reception], names: tuple[str, ...]) -> Receptions:
    """Receptions of one vehicle as a batch; ``names``: all vehicles."""
    sent_ns = [each.sent_ns for each in items]
    arrival_ns = [each.received_ns for each in items]
    rssi_dbm = [each.rssi_dbm for each in items]
    return Receptions(
        names=names,
        messages=tuple(each.message for each in items),
        sent_ns=np.array(sent_ns, np.int64),
        message=np.arange(len(items)),
        receiver=np.full(len(items), names.index(vehicle), np.int64),
        arrival_ns=np.array(arrival_ns, np.int64),
        rssi_dbm=np.array(rssi_dbm, np.float64),
    )


_NOTHING = _SortedBatch(receptions_at("", (), ("",)))
