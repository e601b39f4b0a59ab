"""Zenoh session of the robot with the driver of a run."""

import contextlib
import queue
import time
from typing import TYPE_CHECKING, Any, Literal

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.hosts.host_client import dial
from vcmvsp.cosim.transport import key_names
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import RobotWelcome

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

ANSWER_S = 1.0  # for the answer to a request
WAITING = 256  # messages that may wait; others are dropped, and replaced by later ones

RunMessage = tuple[bytes, int]  # its bytes, and when they arrived, ns


class RunUnreachable(Exception):
    """The run is unreachable now; the text has the reason."""


class RunConnection:
    """A session with a run; without a certificate over plain TCP.

    `RunUnreachable`: there is no run now; `UsageError`: no run can come: another program listens there, or it rejects this
    machine.
    """

    def __init__(self, endpoint: str, bundle: "Bundle | None", vehicle: str) -> None:
        self._name = key_names.OPEN if bundle is None else bundle.name
        self._session = dial(endpoint, bundle, _give_up, secret="")
        self.id = str(self._session.zid())
        self._news: queue.SimpleQueue[RunMessage | Literal["gone"]] = queue.SimpleQueue()
        try:
            down, up, alive = (key_names.robot_key(self._name, vehicle, self.id, each) for each in ("down", "up", "alive"))
            drop = zenoh.CongestionControl.DROP  # later messages replace dropped ones
            self._says = self._session.declare_publisher(up, congestion_control=drop, express=True)
            watch = Callback(self._on_hub, indirect=False)
            self._references: list[Any] = [
                self._session.declare_subscriber(down, Callback(self._on_sample, indirect=False)),
                self._session.liveliness().declare_subscriber(key_names.HUB_ALIVE, watch, history=True),
                self._session.liveliness().declare_token(alive),
            ]
        except BaseException:
            self.close()
            raise

    def greet(self, greeting: bytes) -> RobotWelcome | None:
        """Answer to a request; None: no answer in time."""
        for reply in self._session.get(key_names.greet_key(self._name), payload=greeting, timeout=ANSWER_S):
            if reply.ok is not None:
                with contextlib.suppress(ValueError):
                    return messages.welcomes.decode(reply.ok.payload.to_bytes())
        return None

    def say(self, data: bytes) -> None:
        """Send to the run."""
        self._says.put(data)

    def next(self, wait_s: float) -> RunMessage | Literal["gone"] | None:
        """Next message of the run; "gone" when it ended or is out of reach; None if none comes within this time."""
        try:
            return self._news.get(timeout=wait_s) if wait_s > 0.0 else self._news.get_nowait()
        except queue.Empty:
            return None

    def close(self) -> None:
        """Leave. Never raises."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and "*" not in str(sample.key_expr) and self._news.qsize() < WAITING:
            self._news.put((sample.payload.to_bytes(), time.monotonic_ns()))

    def _on_hub(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._news.put("gone")


def _give_up(why: str) -> None:
    """Called by `dial` before it waits: the caller has a robot to control meanwhile."""
    raise RunUnreachable(why)
