"""Waiting until descriptors are readable or writable, for any number of open files."""

import select
from collections.abc import Sequence

_SELECT_MOST = 1024  # select() takes only descriptors below this


def readable(descriptors: Sequence[int], seconds: float) -> list[int]:
    """The descriptors that are readable or closed at the other side, after at most ``seconds`` (>= 0); empty on timeout.

    Accurate to a few microseconds, but to a millisecond if a descriptor is above 1023.
    """
    if max(descriptors) < _SELECT_MOST:
        return select.select(descriptors, (), (), seconds)[0]
    poll = select.poll()
    for each in descriptors:
        poll.register(each, select.POLLIN)
    return [each for each, _ in poll.poll(1e3 * seconds)]


def writable(descriptor: int, seconds: float) -> bool:
    """Whether a descriptor is writable or closed at the other side, after at most ``seconds`` (>= 0), to a millisecond."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(1e3 * seconds))
