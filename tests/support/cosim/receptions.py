"""Receptions of a run, one by one."""

from collections.abc import Iterable, Iterator

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.received import Mailboxes
from vcmvsp.cosim.types import Reception, Receptions

FAR_NS = 2**62


def receptions_in(events: Iterable[Event]) -> Iterator[tuple[str, Reception]]:
    """Receiver and reception, in order of the events; of one event, by receiver and arrival."""
    for event in events:
        if isinstance(event.value, Receptions):
            mail = Mailboxes(event.value.names, event.value.names)
            mail.put(event.value)
            for vehicle, received in mail.open(FAR_NS).items():
                yield from ((vehicle, each) for each in received)
