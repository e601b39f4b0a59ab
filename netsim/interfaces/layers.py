"""Protocols of the layers of the channel: methods, arguments, answers.

==========================  ==================================  ================================================================
layer                       verb                                question
==========================  ==================================  ================================================================
path_loss, walls,           ``loss_db(paths)``                  how much weaker is the signal at each receiver, on average?
shadowing
fading                      ``gain_db(frame, draw)``            how much stronger is this frame than the average?
phy                         ``air_time_ns(size)``               how long is a frame on the air? (also power, noise, errors)
mac                         ``open(...)``                       who may send when? (`netsim.interfaces.medium`)
loss                        ``lost(frame, draw)``               which receivers lose a frame that their radio has received?
delay                       ``delay_ns(frame, draw)``           how long after its sending may it arrive at the earliest?
script                      ``gain_db(frame, draw)``,           as of fading, loss and delay; the delay counts beyond the
                            ``lost(frame, draw)``,              frame's end
                            ``delay_ns(frame, draw)``
trace                       ``level_dbm(frame)``,               which level has it at each receiver? NaN: as the models say;
                            ``lost(frame, draw)``,              as of loss and delay, on links that are ``traced``
                            ``delay_ns(frame, draw)``,
                            ``traced(frame)``
jammer                      ``interference_mw(start_ns,         how much power of others reaches each receiver meanwhile?
                            end_ns, rx, loss_db, where)``
delivery                    ``open(count)``,                    when does what was received arrive, and a copy of it? -1: never
                            ``deliver(sender_row, rows,
                            received_ns, size_bytes, draw)``
==========================  ==================================  ================================================================

A jammer gets ``loss_db(at, rx)``, the mean loss from a point (3,) to receivers (n, 3), (n,) dB, and ``where(name)``, the
position of a vehicle. ``loss``, ``script``, ``trace`` and ``delivery`` have a ``cause``: the outcome in recordings of frames
that they lose. ``columns`` of a trace names its quantities: ``snr_db``, ``rssi_dbm``, ``loss``, ``delay_s``. ``names()`` of a
trace or jammer returns the vehicles that it names, ``unmatched(vehicles)`` of a script its key expressions that match no link.

A layer is any object with the method: no base class. It answers for all receivers at once; each answer depends on that
receiver alone, and equal arguments give equal answers: random numbers come from ``draw``, or from the keys of the links. A
layer with a true attribute ``nothing``, such as a loss of probability 0, is skipped. A loss or delay that depends on its draws
alone may have a method ``lost_by(draws)`` or ``delay_ns_by(draws)``, called instead for many frames at once, draws
(..., n, 2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, Protocol, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcmvsp.cosim.rng import keys64, link_uniform
from vcmvsp.cosim.types import Decibels, FileName, NonNegative

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Keys = NDArray[np.uint64]
BitRate = Annotated[float, msgspec.Meta(ge=1.0, le=1e15)]  # bit/s

US = 1_000  # ns

T = TypeVar("T", bound=np.generic)

Draw = Callable[[], Floats]
"""Two independent uniforms in [0, 1) for each receiver, (n, 2), of this layer and frame; equal at every call."""


def sealed(fresh: NDArray[T]) -> NDArray[T]:
    """Make a new array read-only: `cosim.types.frozen` without the copy."""
    fresh.setflags(write=False)
    return fresh


class Paths(msgspec.Struct, frozen=True):
    """The straight lines from one antenna to n others."""

    tx: Floats  # (3,) m, world
    rx: Floats  # (n, 3) m, world
    distance_m: Floats  # (n,) three-dimensional
    seed: int = 0  # of the run
    antennas: Any = None  # `netsim.propagation.antennas.LinkAntennas`; None: all are isotropic

    @classmethod
    def between(cls, tx: Floats, rx: Floats, seed: int = 0) -> Self:
        """Paths from the point ``tx`` (3,) to the points ``rx`` (n, 3)."""
        return cls(tx, rx, sealed(distances(tx, rx)), seed)


def distances(tx: Floats, rx: Floats) -> Floats:
    """Distances between points (..., 3), m."""
    squared = rx - tx
    squared *= squared
    return np.sqrt(squared[..., 0] + squared[..., 2] + squared[..., 1])  # this order: the last bits depend on it


def distance_of(paths: Paths | ArrayLike) -> Floats:
    """The distances of paths; given distances are returned unchanged."""
    return paths.distance_m if isinstance(paths, Paths) else np.asarray(paths, np.float64)


class SenderLinks:
    """The links from one radio to n others, with their random keys."""

    def __init__(self, seed: int, sender: str, receivers: tuple[str, ...]) -> None:
        self.seed, self.sender, self.receivers = seed, sender, receivers

    @cached_property
    def keys(self) -> Keys:
        """Random keys of the links, (n,): from A to B another than from B to A."""
        return keys64(self.seed, [f"radio/{self.sender}/{name}" for name in self.receivers])

    @cached_property
    def pair_keys(self) -> Keys:
        """Random keys of the pairs, (n,), equal for both directions."""
        return keys64(self.seed, ["/".join(("radio", *sorted((self.sender, name)))) for name in self.receivers])


class Frame(msgspec.Struct, frozen=True):
    """One frame as it reaches n receivers."""

    sent_ns: int  # time of sending, before the queue
    start_ns: int  # on the air
    end_ns: int  # on the air
    size_bytes: int  # payload
    paths: Paths
    rssi_dbm: Floats  # (n,) received level: the mean for layers before fading, of this frame for those behind it
    links: SenderLinks

    @property
    def sender(self) -> str:
        """The vehicle that sends it."""
        return self.links.sender

    @property
    def receivers(self) -> tuple[str, ...]:
        """The n other radios."""
        return self.links.receivers

    @property
    def keys(self) -> Keys:
        """Random keys of the links, (n,), see `SenderLinks.keys`."""
        return self.links.keys

    @property
    def pair_keys(self) -> Keys:
        """Random keys of the pairs, (n,), see `SenderLinks.pair_keys`."""
        return self.links.pair_keys


L = TypeVar("L")


def unless_nothing(layer: L | None) -> L | None:
    """The layer, unless it does nothing."""
    return None if getattr(layer, "nothing", False) else layer


class PathLoss(Protocol):
    """Attenuation by distance or obstacles.

    With a true attribute ``by_distance`` it depends on ``paths.distance_m`` alone, and accepts distances of any shape instead
    of the paths. One that knows the paths of the wave may have a method ``delays_ns(paths)``: travel time of the first path,
    and standard deviation over all paths by power, (n,) ns each; and ``antenna_gain(paths)``, the gain of both antennas over
    isotropic ones, (n,), a ratio, if it is not that of the straight line; ``holder(points)``, for each of the points (n, 3) the
    solid that it is inside, in words, or an empty text.
    """

    def loss_db(self, paths: Paths) -> Floats:
        """Loss of each path, (n,) dB: finite, and the same in both directions."""


class Fading(Protocol):
    """Difference between the level of one frame and the mean level."""

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Power gain at each receiver, (n,) dB, to be added to the level: finite, and 1 on average as a ratio."""


class Phy(Protocol):
    """A radio standard at one bit rate.

    Optional attributes: ``noise_dbm`` (default: thermal noise in 20 MHz and 7 dB), ``errors`` (a
    `netsim.phy.error_rate.ErrorRate`; default: none) and ``preamble_snr_db``, the detection threshold (default: none).
    """

    @property
    def tx_power_dbm(self) -> float:
        """Transmitted power."""

    @property
    def sensitivity_dbm(self) -> float:
        """The weakest level that is received."""

    def air_time_ns(self, size_bytes: int) -> int:
        """Time on the air of a frame with this payload; at least 1 ns, and never less for a longer payload."""


class Loss(Protocol):
    """Losses of received frames."""

    @property
    def cause(self) -> str:
        """Outcome of frames lost by this layer, in recordings."""

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""


class Delay(Protocol):
    """Delay beyond the time on the air."""

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception after sending, (n,) ns; no frame arrives before its end."""


# The draws of each layer, by frame. A number that is changed changes every recorded run: new layers take new ones.
LOSS_SLOT = 1
DELAY_SLOT = 2
FADING_SLOT = 3
SCRIPT_SLOT = 4
TRACE_SLOT = 5
DELIVERY_SLOT = 6
JAMMER_SLOT = 7
ERROR_SLOT = 32  # and following: one for each attempt to send the frame
RETRY_FADING_SLOT = 64  # and following: fading of each attempt but the first
ACK_FADING_SLOT = 96  # and following: fading of the acknowledgement of each attempt
# Draws that do not go by frames.
WAVE_SLOT = 16  # fading in time: the waves of a pair
BURST_SLOT = 17  # bursts: new states of a link, and their times
BACKOFF_SLOT = 18  # backoffs of a radio

Make = Callable[[Floats], NDArray[Any]]
"""Function of draws (..., n, 2) alone, (..., n)."""

_BLOCK_LINKS = 4096  # links x frames in a block: 64 KiB, where the cost per number has become flat
_BLOCK_FRAMES = 256  # at most, so that short runs do not pay for what they never use


class LinkDraws:
    """Draws for the links from one sender to each of n receivers."""

    def __init__(self, links: SenderLinks) -> None:
        self._links = links
        self._frames = max(1, min(_BLOCK_FRAMES, _BLOCK_LINKS // max(1, len(links.receivers))))
        self._blocks: dict[int, tuple[int, Floats]] = {}  # slot: number of the block, its draws (frames, n, 2)
        self._results: dict[int, tuple[int, Make, NDArray[Any]]] = {}  # slot: number of the block, function, its result

    def uniform(self, frame: int, slot: int) -> Floats:
        """Two uniforms in [0, 1) for each receiver, (n, 2), of the sender's own frame number ``frame``."""
        number, index = divmod(frame, self._frames)
        return self._block(number, slot)[index]

    def patience(self, frame: int, slot: int) -> Floats:
        """Exponential variates of mean 1 for each receiver, (n,), from the first of its uniforms."""
        return self.compute(frame, slot, _exponential)

    def compute(self, frame: int, slot: int, make: Make) -> NDArray[Any]:
        """Result of ``make`` for the draws of a frame, (n,), computed for a whole block at once, (frames, n, 2)."""
        number, index = divmod(frame, self._frames)
        cached = self._results.get(slot)
        if cached is None or cached[0] != number or cached[1] != make:
            cached = self._results[slot] = (number, make, make(self._block(number, slot)))
        return cached[2][index]

    def _block(self, number: int, slot: int) -> Floats:
        cached = self._blocks.get(slot)
        if cached is None or cached[0] != number:
            frames = np.arange(number * self._frames, (number + 1) * self._frames, dtype=np.uint64)
            cached = self._blocks[slot] = (number, link_uniform(self._links.keys, frames[:, None], slot))
        return cached[1]


def _exponential(draws: Floats) -> Floats:
    return -np.log1p(-draws[..., 0])


@dataclass(frozen=True)
class Radio:
    """A vehicle's antenna and, where they differ from the phy's, its power and sensitivity.

    The level at a receiver is the sender's power plus both antenna gains, less what is lost between. A dipole and a pattern
    turn with the vehicle; with rays each path has its own directions, else all have that of the straight line.
    """

    tx_power_dbm: Decibels | None = None  # transmitted power; None: the phy's
    sensitivity_dbm: Decibels | None = None  # weakest level at which it notices a frame; None: the phy's
    antenna_gain_dbi: Decibels = 0.0  # gain for sending and receiving, in all directions
    antenna: Literal["isotropic", "dipole"] = "isotropic"  # dipole: half-wave along the body's z axis, 2.15 dBi across it
    antenna_pattern: FileName | None = None  # in place of antenna: CSV file elevation_deg,azimuth_deg,gain_dbi, body frame
    antenna_height_m: NonNegative = 0.5  # above the vehicle's position
    body_loss_db: NonNegative = 0.0  # loss of links between other vehicles through this body
    body_radius_m: NonNegative = 0.3  # of its body, an upright cylinder that begins at its position
    body_height_m: NonNegative = 0.6  # of that cylinder


AT_POSITION = Radio(antenna_height_m=0.0)
"""A radio whose antenna is where its vehicle is."""
