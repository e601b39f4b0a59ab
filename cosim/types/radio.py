"""What the radio carries, for agents and for programs outside, and what becomes of it."""

from typing import Any

from vcmvsp.cosim.types.quantities import Array, Value


class Message(Value, frozen=True, kw_only=True, tag="message"):
    """What an agent hands to its radio. The body crosses the air as MessagePack; ``size_bytes`` sets the air time."""

    sender: str
    body: dict[str, Any] | bytes
    size_bytes: int
    to: str | None = None  # None: broadcast
    priority: int = 0  # one of a higher priority overtakes those that wait in its sender's queue, where the mac has one


class Reception(Value, frozen=True, kw_only=True, tag="reception"):
    """A message as it arrived."""

    message: Message
    rssi_dbm: float
    sent_ns: int
    received_ns: int


class FrameReport(Value, frozen=True, kw_only=True, tag="frame"):
    """What became of one frame at every receiver it was meant for; the rows of ``radio.parquet``."""

    frame: int  # unique in the run, in the order in which frames entered the channel
    sender: str
    sent_ns: int
    size_bytes: int
    receivers: tuple[str, ...]
    distance_m: Array  # (n,) float64
    rssi_dbm: Array  # (n,) float64
    received_ns: Array  # (n,) int64; -1: lost
    outcome: tuple[str, ...]  # "received" or the cause of the loss, per receiver
    air_time_ns: int = 0  # one transmission; 0: it was never sent
    queue_ns: int = 0  # waited behind the sender's earlier frames
    access_ns: int = 0  # waited for the air, earlier attempts included
    copy_ns: Array | None = None  # (n,) int64, when a second copy arrives; -1: none does
    # The link budget, (n,) each; None where the channel has no such layer.
    snr_db: Array | None = None  # over noise alone
    sinr_db: Array | None = None  # over noise and interference, the least while it was on the air
    path_loss_db: Array | None = None
    walls: Array | None = None  # int64, how many are crossed
    wall_materials: tuple[str, ...] | None = None  # e.g. "2 brick, 1 wood"
    wall_loss_db: Array | None = None
    shadowing_db: Array | None = None
    fading_db: Array | None = None  # a gain


class Datagrams(Value, frozen=True, kw_only=True, tag="datagrams"):
    """What programs outside have handed to the radios of their vehicles, in the order in which it came."""

    number: Array  # (n,) int64, unique in the run
    sender: Array  # (n,) int32, rows of the run's vehicles
    to: Array  # (n,) int32, the only one meant; -1: broadcast
    size_bytes: Array  # (n,) int64, payload
    sent_ns: Array  # (n,) int64, when it came, a little before or after now; decreases for no sender
    payloads: tuple[bytes, ...] = ()  # where agents are to hear it; else it never leaves whoever carries it


class Traffic(Value, frozen=True, kw_only=True, tag="traffic"):
    """What became of datagrams."""

    reports: tuple[FrameReport, ...]  # of all frames that were sent for them
    carries: Array  # (len(reports),) int64, the number of the datagram in each
    number: Array  # (m,) int64, of datagrams that arrive where they are meant to
    receiver: Array  # (m,) int32, there
    arrival_ns: Array  # (m,) int64, when; may be earlier than now, if whoever carries it was late
    frame: Array  # (m,) int64, that brought it: with routing the last of several
    settled: Array  # (k,) int64, numbers of those of which nothing is to come any more


class Routed(Value, frozen=True, kw_only=True, tag="routed"):
    """What became of a message that others may have passed on, once nothing of it is under way or the run has ended."""

    origin: str
    number: int  # among those of its origin
    to: str | None  # None: broadcast
    sent_ns: int
    size_bytes: int  # payload
    frame_bytes: int  # of each frame: that, and what routing adds
    frames: tuple[int, ...]  # that were sent for it, in their order; none: there was no route
    receivers: tuple[str, ...]  # whom it reached, relays included, in the order of time
    hops: tuple[int, ...]  # on the way to each of them
    via: tuple[str, ...]  # from whom each of them had it
    received_ns: tuple[int, ...]
    update: bool = False  # of routes: no message, but what vehicles tell each other
    under_way: bool = False  # when the run ended: it may have reached more
