"""Poses that are published over Eclipse Zenoh as JSON, e.g. by a bridge from motion capture.

A message is an object: ``t`` (s, time of the measurement, of any running clock), ``x`` and ``y`` (m), and optionally ``z`` (m),
``yaw`` (rad), ``sigma`` (m) and ``sigma_yaw`` (rad). Without ``t`` the measurement was ``latency_s`` before the arrival. Other
keys are ignored.
"""

import time
from functools import partial
from typing import Any, Literal

import msgspec
import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.endpoints import with_slash
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.cosim.types import ORIGIN, NonNegative, Positive, Vec3
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.localisation.source import Advice, DatagramReader, Located, PositionSource, WorldTransform

LARGEST_BYTES = 4096
_CONNECT_MS = 2000
_RETRY = {"period_init_ms": 100, "period_max_ms": 500}  # of a broken link


class _PoseMessage(msgspec.Struct, kw_only=True):
    x: float
    y: float
    t: float | None = None
    z: float = 0.0
    yaw: float | None = None
    sigma: NonNegative | None = None
    sigma_yaw: NonNegative | None = None


_decoder = msgspec.json.Decoder(_PoseMessage)  # JSON has neither NaN nor infinity


def decode(sigma_rad: float, chunk: bytes) -> Located:
    """Position of a message; ``sigma_rad`` is the standard deviation of a yaw without ``sigma_yaw``."""
    if len(chunk) > LARGEST_BYTES:
        raise ValueError(f"a pose has at most {LARGEST_BYTES} bytes")
    pose = _decoder.decode(chunk)
    source_ns = None if pose.t is None else round(pose.t * SECOND_NS)
    sigma_rad = sigma_rad if pose.sigma_yaw is None else pose.sigma_yaw
    position = (pose.x, pose.y, pose.z)
    return Located(position=position, yaw=pose.yaw, sigma_rad=sigma_rad, sigma_m=pose.sigma, source_ns=source_ns)


class ExternalPose(PositionSource):
    """Poses published as JSON over Eclipse Zenoh: a bridge from motion capture, another localisation.

    Zenoh restores a broken link.

    Args:
        key: key of the poses, such as ``mocap/car1``.
        endpoint: of the router or bridge, or where to listen.
        mode: whether to connect there, or to listen so that the bridge connects.
        sigma_m: standard deviation of x and y without ``sigma``.
        sigma_rad: standard deviation of the yaw without ``sigma_yaw``.
        latency_s: minimum delay from measurement to arrival.
        offset: of the poses' frame in the world, m.
        turn_rad: of their frame in the world.
    """

    def __init__(
        self,
        *,
        key: str,
        endpoint: str = "tcp/127.0.0.1:7447",
        mode: Literal["connect", "listen"] = "connect",
        sigma_m: Positive = 0.01,
        sigma_rad: Positive = 0.02,
        latency_s: NonNegative = 0.01,
        offset: Vec3 = ORIGIN,
        turn_rad: float = 0.0,
    ) -> None:
        try:
            self._key = zenoh.KeyExpr(key)
        except zenoh.ZError:
            raise ValueError(f"a key must consist of words and slashes, such as mocap/car1, not '{key}'") from None
        words = Advice(
            f"check that a bridge publishes poses under {key} at {endpoint}",
            f'messages under {key} are not poses; format: {{"t": s, "x": m, "y": m}}, with "z", "yaw", "sigma" if known',
        )
        transform = WorldTransform(sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad)
        super().__init__(f"{key} at {endpoint}", DatagramReader(partial(decode, sigma_rad)), transform, words)
        self._endpoint, self._mode = with_slash(endpoint), mode
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Connect, or listen, and subscribe; `PortError`: no router is there, or the address cannot be bound."""
        self._begin()
        config: dict[str, Any] = {"mode": "router", "listen": {"endpoints": [self._endpoint]}}
        advice = "use a free port of this machine"
        if self._mode == "connect":
            connect = {"endpoints": [self._endpoint], "timeout_ms": _CONNECT_MS, "exit_on_failure": True, "retry": _RETRY}
            config = {"mode": "client", "listen": {"endpoints": []}, "connect": connect}
            advice = "start the router or the bridge"
        try:
            self._session = opened(config, access_control.LIMITS, f"no Zenoh session at '{self._endpoint}'")
        except UsageError as error:
            raise PortError(self.device, str(error), advice) from None
        try:
            self._session.declare_subscriber(self._key, Callback(self._on_sample, indirect=False))
        except zenoh.ZError as error:
            self.close()
            raise PortError(self.device, f"cannot receive there ({error})", "connect again") from None

    def close(self) -> None:
        """Leave. May be called twice."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self.take(sample.payload.to_bytes(), time.monotonic_ns())
