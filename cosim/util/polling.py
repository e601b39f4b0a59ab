"""Waiting for descriptors to have something to read, or to take bytes, however many files the process has open."""

import select
from collections.abc import Sequence

_SELECT_MOST = 1024  # descriptors from there on select() does not take


def readable(descriptors: Sequence[int], seconds: float) -> list[int]:
    """Those that can be read, or whose other side has gone, after at most so many seconds (>= 0); none: time is over.

    Good to a few microseconds, but to a millisecond where one of the descriptors is above 1023.
    """
    if max(descriptors) < _SELECT_MOST:
        return select.select(descriptors, (), (), seconds)[0]
    poll = select.poll()
    for each in descriptors:
        poll.register(each, select.POLLIN)
    return [each for each, _ in poll.poll(1e3 * seconds)]


def writable(descriptor: int, seconds: float) -> bool:
    """Whether it takes bytes, or its other side has gone, after at most so many seconds (>= 0), to a millisecond."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(1e3 * seconds))
