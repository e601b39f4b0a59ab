"""Reads MCAP files, whole ones and those of a process that was killed while it wrote."""

import contextlib
import itertools
import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from mcap import records
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader


class Recorded(NamedTuple):
    """A message of a file."""

    topic: str
    schema: str  # its name
    time_ns: int
    data: bytes


def about(stream: BinaryIO) -> dict[str, str]:
    """What the head of a file says of it; empty: nothing, or it is damaged."""
    with contextlib.suppress(ValueError):
        for record in itertools.islice(_records(stream), 2):  # behind the header
            if isinstance(record, records.Metadata):
                return dict(record.metadata)
    return {}


def messages(stream: BinaryIO) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time (ns) and content of each message of a file, in its order.

    Raises:
        ValueError: from here on the file is damaged, or it ends too soon.
    """
    for topic, _, time_ns, data in contents(stream):
        yield topic, time_ns, data


def of_topic(stream: BinaryIO, topic: str) -> Iterator[tuple[int, bytes]]:
    """Time (ns) and content of each message of one topic, by the index at the end; of a file without one, up to its damage.

    Raises:
        ValueError: a chunk that the index names is damaged.
    """
    try:
        whole = make_reader(stream).get_summary() is not None
    except Exception:  # the library has many
        whole = False
    stream.seek(0)
    if not whole:
        with contextlib.suppress(ValueError):
            yield from ((time_ns, data) for name, time_ns, data in messages(stream) if name == topic)
        return
    try:
        for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(topics=[topic]):
            yield message.log_time, message.data
    except Exception as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def contents(stream: BinaryIO) -> Iterator[Recorded]:
    """Each message of a file, in its order.

    Raises:
        ValueError: from here on the file is damaged, or it ends too soon.
    """
    schemas: dict[int, str] = {}
    topics: dict[int, tuple[str, str]] = {}
    for record in _records(stream):
        if isinstance(record, records.Message):
            if record.channel_id not in topics:
                raise ValueError(f"a message of channel {record.channel_id}, which there is not")
            yield Recorded(*topics[record.channel_id], record.log_time, record.data)
        elif isinstance(record, records.Channel):
            topics[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, records.Schema):
            schemas[record.id] = record.name


def _records(stream: BinaryIO) -> Iterator[records.McapRecord]:
    """Header and data of a file, without its end."""
    found = StreamReader(stream, validate_crcs=True).records
    while True:
        try:
            record = next(found)
        except (EndOfFile, struct.error) as error:
            raise ValueError("it ends too soon") from error
        except Exception as error:  # the library has many, and those of others show through
            raise ValueError(f"{type(error).__name__}: {error}") from error
        if isinstance(record, records.DataEnd):
            return
        yield record
