"""Messages longer than a frame of their standard: several frames, one behind the other, received or lost as one."""

from collections.abc import Callable

LARGEST_MSDU_BYTES = 2304 - 8  # IEEE 802.11-2016, 9.2.4.7.1: payload of an MSDU, without LLC and SNAP


def over_frames(size_bytes: int, largest_bytes: int, of_frame: Callable[[int], int], between: int = 0) -> int:
    """Sum over the frames of a message: full ones and the last.

    Args:
        size_bytes: of the message.
        largest_bytes: payload of one frame.
        of_frame: what a frame with this payload adds.
        between: what the space from one frame to the next adds.
    """
    full = max(0, -(-size_bytes // largest_bytes) - 1)
    return full * (of_frame(largest_bytes) + between) + of_frame(size_bytes - full * largest_bytes)
