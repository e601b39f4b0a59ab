"""The port at which a run awaits the hosts that it has started is on loopback, for everybody to find: only they come in."""

import contextlib
from typing import Any

import pytest
import zenoh

from tests.support.cosim.secure_hub import QUIET, start
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.transport import access_control
from vcmvsp.cosim.transport.access_control import merge

PASSWORDS = {"car1": "a0" * 16, "car2": "b1" * 16}


def dial(hub: Hub, login: dict[str, Any]) -> zenoh.Session:
    own = {"mode": "client", "listen": {"endpoints": []}, "connect": {"endpoints": [hub.endpoint], "timeout_ms": 0}}
    return start(merge(QUIET, own, login))


def test_whoever_has_a_password_comes_in_and_nobody_else(stack: contextlib.ExitStack) -> None:
    hub = Hub(children=PASSWORDS)
    stack.callback(hub.close)
    assert hub.endpoint.startswith("tcp/127.0.0.1:")
    wrong: tuple[dict[str, Any], ...] = (
        {},
        access_control.child_security("car1", PASSWORDS["car2"]),
        access_control.child_security("car3", PASSWORDS["car2"]),
        access_control.child_security("car1", ""),
    )
    for login in wrong:
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            dial(hub, login)
    sessions = [stack.enter_context(dial(hub, access_control.child_security(*each))) for each in PASSWORDS.items()]
    assert all([str(each) for each in session.info.routers_zid()] == [str(hub.session.zid())] for session in sessions)
