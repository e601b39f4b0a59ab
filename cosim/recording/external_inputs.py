"""Records external inputs of a run in ``hardware.mcap``, so that the run can be replayed.

Real vehicles, stacks and external programs make a run that scenario and seed cannot reproduce. All their data are recorded
here with their times and to the last bit, as MessagePack (`cosim.util.codec`) in an MCAP file. ``run.mcap`` is for people and
viewers; this file is for `cosim.runs.replay`.

=======================  ==========================================================================================
``<vehicle>/<topic>``    an event from the vehicle: estimate, odometry, fixes, readings, status
``<vehicle>/reflected``  the motion that physics received, at each instant (`cosim.federate.ExternalMotion`)
``<vehicle>/command``    answers of a stack at a tick (`cosim.federate.Stack`): also ``send``, or ``host`` without one
``bridge/sent``          datagrams that programs gave to radios: numbers, sizes, times (`Datagrams`)
=======================  ==========================================================================================
"""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, get_args, get_origin, get_type_hints

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.recording.mcap_reader import messages
from vcmvsp.cosim.recording.mcap_writer import Form, McapLog, Schema
from vcmvsp.cosim.types import AnyValue, Later
from vcmvsp.cosim.util.codec import Decoder, encode

FILE = "hardware.mcap"
REFLECTED = "reflected"  # topic of the motion that physics received
LOST_NS = SECOND_NS  # a killed process loses at most this much

Input = tuple[str, int, AnyValue]
"""Key, time (ns) and value."""


def schema_of(kind: type) -> Schema:
    """Field names and types of a value as text."""
    fields = "\n".join(f"{name}: {_words(hint)}" for name, hint in get_type_hints(kind).items() if not name.startswith("__"))
    text = f"A MessagePack map of these fields and 'type'; an array is [dtype of NumPy, shape, bytes].\n{fields}\n"
    return Schema(f"vcmvsp.{kind.__name__}", "x-text", text.encode())


def encode_into(value: object, buffer: bytearray, place: int) -> None:
    """Encode the value into the buffer at ``place``, at or after its end; the buffer then ends with the value."""
    data = encode(value)
    buffer += bytes(place - len(buffer)) + data


MSGPACK = Form("msgpack", encode_into, schema_of)


class InputLog:
    """Writes the file during the run, after `open`; a crash loses at most the last second."""

    def __init__(self) -> None:
        self._memory: io.BytesIO | None = None
        self._log: McapLog | None = None
        self._due_ns = LOST_NS

    def open(self, stream: BinaryIO | None = None) -> None:
        """Start writing to a binary stream, which the caller closes, or to memory (None; see `content`)."""
        if stream is None:
            stream = self._memory = io.BytesIO()
        self._log = McapLog(stream, {"content": "inputs"}, MSGPACK)

    def on(self, key: str, time_ns: int, value: AnyValue) -> None:
        """Write a value if the file is open; times never decrease."""
        if self._log is None:
            return
        if time_ns >= self._due_ns:
            self._log.flush()
            self._due_ns = time_ns + LOST_NS
        self._log.write(key, time_ns, value.get() if isinstance(value, Later) else value)

    def close(self) -> None:
        """Finish the file. Repeated calls are allowed."""
        if self._log is not None:
            self._log.finish()
            self._log = None

    @property
    def content(self) -> bytes:
        """The bytes of a file in memory."""
        return b"" if self._memory is None else self._memory.getvalue()


def read_inputs(path: str | Path, *, tell: Callable[[str], None] = lambda _: None) -> list[Input]:
    """All inputs of such a file, in order; of a damaged file, those before the damage, which ``tell`` reports.

    Raises:
        UsageError: the file does not exist or is unreadable.
    """
    decoder: Decoder[Any] = Decoder(AnyValue)
    inputs: list[Input] = []
    try:
        with Path(path).open("rb") as stream:
            for key, time_ns, data in messages(stream):
                inputs.append((key, time_ns, decoder.decode(data)))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        if not inputs:
            raise UsageError(f"{path}: cannot be read ({error})") from error
        tell(f"{path} is damaged ({error}): it can be read up to {inputs[-1][1] / SECOND_NS:.3f} s")
    return inputs


class EventPlayback:
    """A federate that publishes recorded ``events``, in order, each at its time."""

    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    reads: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(self, name: str, events: Sequence[Event]) -> None:
        self.name, self.events = name, events

    def start(self, run: RunInfo) -> int | None:
        """Time of the first event."""
        self._next = 0
        return self.events[0].time_ns if self.events else None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """The events of this instant."""
        first, events = self._next, self.events
        while self._next < len(events) and events[self._next].time_ns <= now_ns:
            self._next += 1
        return Step(events[first : self._next], events[self._next].time_ns if self._next < len(events) else None)

    def close(self) -> None:
        """Nothing to release."""


def _words(hint: object) -> str:
    if "ndarray" in str(hint):
        return "array" if get_origin(hint) is np.ndarray else "array | None"
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint).replace("typing.", "")
