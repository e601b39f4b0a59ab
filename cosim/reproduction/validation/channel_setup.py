"""A channel by itself, as ``[radio]`` of a scenario describes it, and frames that are sent through it."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.assembly.parts.radio import Channel
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.types import Array, FrameReport, Message


def channel(preset: str = "ideal", *, seed: int = 1, **layers: object) -> Channel:
    """A channel of a preset with some layers changed, which draws from ``seed``."""
    built: Channel
    built, _ = radio.build({"preset": preset, **layers}, Source("validation", Path()))
    built.start(seed)
    return built


def names_of(count: int) -> tuple[str, ...]:
    """So many vehicles."""
    return tuple(f"v{number}" for number in range(count))


def line(distances_m: Sequence[float], height_m: float = 0.0) -> Array:
    """Antennas: one at x = 0, the others at these distances on the x axis."""
    return np.array([(x, 0.0, height_m) for x in (0.0, *distances_m)])


def send(
    on: Channel, position: Array, *, sent_ns: int = 0, sender: int = 0, to: int | None = None, size_bytes: int = 100
) -> list[FrameReport]:
    """One frame among vehicles at these places (n, 3); what is decided by it."""
    names = names_of(len(position))
    message = Message(sender=names[sender], body={}, size_bytes=size_bytes, to=None if to is None else names[to])
    return on.send(sent_ns, message, names, position)


def heard(on: Channel, position: Array, **frame: int) -> FrameReport:
    """The report of a frame on a channel that decides at once."""
    (report,) = send(on, position, **frame)
    return report


def part(name: str, on: Channel, position: Array, **frame: int) -> Array:
    """A part of the link budget of a frame at all its receivers, by its name in the report."""
    return np.asarray(getattr(heard(on, position, **frame), name))


def decided(on: Channel) -> Iterator[FrameReport]:
    """The reports of all frames that are still open."""
    while (due_ns := on.next_ns()) is not None:
        yield from on.advance(due_ns + SECOND_NS)
