"""Garbage sent to the port of a run does not disturb its hosts: same digest."""

import contextlib
import random
import socket
import ssl
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

import vcmvsp
from tests.support.cosim.run_processes import Stage, exit_of, wait_for
from tests.support.cosim.teams import FOLLOWER, WAITS, team
from vcmvsp.cosim.hosts import protocol as wire
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.security import authority
from vcmvsp.cosim.transport import key_names
from vcmvsp.cosim.transport.zenoh_session import client

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

AGENTS = 'kind = "waits.py:Waits", until = 1.5', FOLLOWER
SCENARIO = team("garbage", *AGENTS, duration_s=2.0, runs="zenoh", deadline_s=300.0, join_timeout_s=300.0)
CONNECTIONS = 300
SPARE_JOINS = 64  # join requests that may wait, in addition to one for each expected host


def garbage(draw: random.Random, number: int, endpoint: tuple[str, int]) -> socket.socket:
    """One connection: silent, random bytes, random bytes in a Zenoh frame or in a TLS record, or only a valid TLS greeting."""
    connection = socket.create_connection(endpoint, timeout=10.0)
    kind = number % 5
    if kind == 1:
        connection.sendall(draw.randbytes(draw.choice([1, 300, 70_000])))
    elif kind == 2:  # length of a Zenoh frame, and random bytes
        connection.sendall(draw.choice([b"\xff\xff", b"\x20\x00", b"\x00\x00"]) + draw.randbytes(40))
    elif kind == 3:  # head of a TLS record, and random bytes or nothing
        connection.sendall(b"\x16\x03\x01\x02\x00\x01" + draw.randbytes(draw.choice([0, 100, 511])))
    elif kind == 4:  # a valid TLS greeting, whose answer is not read
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        with pytest.raises(ssl.SSLWantReadError):
            context.wrap_bio(incoming, outgoing).do_handshake()
        connection.sendall(outgoing.read())
    return connection


@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_a_run_survives_three_hundred_connections_of_garbage(protocol: str, tmp_path: Path) -> None:
    with Stage(tmp_path) as stage:
        (tmp_path / "garbage.toml").write_text(SCENARIO)
        (tmp_path / "waits.py").write_text(WAITS)
        endpoint, with_keys, host_keys = f"{protocol}/127.0.0.1:{stage.port}", [], []
        if protocol == "tls":
            authority.init(tmp_path / "keys")
            bundle = authority.issue(tmp_path / "keys", "machine", ["car1", "car2"])
            with_keys, host_keys = ["--keys", "keys"], ["--keys", str(bundle.path)]
        run = stage.start("run", "garbage.toml", "--listen", endpoint, *with_keys, "--realtime", "--out", "out")
        hosts = [
            stage.start("agent", "--vehicle", name, "--folder", ".", "--connect", endpoint, *host_keys)
            for name in ("car1", "car2")
        ]
        wait_for(stage.out / "run.mcap")
        draw, connections = random.Random(1), list[socket.socket]()
        for number in range(CONNECTIONS):
            with contextlib.suppress(OSError):  # the run may have closed it already
                connections.append(garbage(draw, number, ("127.0.0.1", stage.port)))
            if number % 3 == 0:
                connections.pop(draw.randrange(len(connections))).close()
            time.sleep(0.005)
        assert run.poll() is None  # all of it arrived during the run
        for connection in connections:
            connection.close()  # else, some would delay the end of the run by seconds
        (tmp_path / "go").touch()
        code, output = exit_of(run)
        assert code == 0, output
        assert [exit_of(host)[0] for host in hosts] == [0, 0]
        digest = stage.digest()
    assert digest == vcmvsp.run(tmp_path / "garbage.toml", agents="inprocess", mcap=False).metrics["digest"]


def greeting(number: int) -> bytes:
    return wire.encode(wire.Hello(f"{number:032x}", wire.PROTOCOL, (f"car{number}",)))


def greeted(session: zenoh.Session, hello: bytes | int) -> Any:
    """Replies to a greeting, or to that of the host with this number."""
    payload = greeting(hello) if isinstance(hello, int) else hello
    return session.get(key_names.join_key("anyone"), payload=payload, timeout=10.0)


def refusal(replies: Any) -> str | None:
    return wire.welcomes.decode(replies.recv().ok.payload.to_bytes()).refused


def test_all_expected_hosts_may_join_at_once_and_a_flood_is_refused(stack: contextlib.ExitStack) -> None:
    expected = 100
    hub = stack.enter_context(contextlib.closing(Hub(hosts=expected)))
    session = stack.enter_context(client(hub.endpoint, {}, "cannot connect"))
    replies = [greeted(session, number) for number in range(expected + 2 * SPARE_JOINS)]
    for late in replies[expected + SPARE_JOINS :]:
        assert refusal(late) == "too many join requests at once; try again"
    knocks = [hub.next_hello(10.0) for _ in range(expected + SPARE_JOINS)]
    assert [knock and knock.hello.vehicles for knock in knocks] == [(f"car{n}",) for n in range(expected + SPARE_JOINS)]


def test_an_invalid_greeting_is_refused_and_the_next_host_accepted(stack: contextlib.ExitStack) -> None:
    """Without certificates, any program on this machine can send anything to the port."""
    draw, honest = random.Random(2), greeting(2)
    other = wire.encode(wire.Hello("../b/*", wire.PROTOCOL, ("car2",)))  # its name would form another key
    hub = stack.enter_context(contextlib.closing(Hub()))
    session = stack.enter_context(client(hub.endpoint, {}, "cannot connect"))
    for number in range(200):
        nonsense = draw.randbytes(draw.choice([0, 10, 5000])), honest[: draw.randrange(len(honest))], other
        replies = greeted(session, nonsense[number % 3])
        assert hub.next_hello(10.0) is None
        assert refusal(replies) == "that is not the join request of a vcmvsp host"
    replies = greeted(session, 2)
    knock = hub.next_hello(10.0)
    assert knock is not None
    assert knock.hello.vehicles == ("car2",)
    assert knock.answer(None) is not None
    assert refusal(replies) is None
