"""Sockets for programs in the time of a run: without a run, and with one that sends nonsense."""

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp.cosim.sockets import RunOver, Socket, connect
from vcmvsp.cosim.sockets.messages import Go, Over, Refused, Stream, Wait, Welcome, framed, up

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

WELCOME, GO = framed(Welcome("run", ("a", "b"))), framed(Go(0, None, []))


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as end:
        yield end


def serve(server: socket.socket, *says: bytes) -> str:
    """Send ``says`` and an end of stream to the first client; returns the endpoint."""

    def answer() -> None:
        end, _ = server.accept()
        with end:
            end.sendall(b"".join(says))
            end.shutdown(socket.SHUT_WR)
            while end.recv(1 << 16):
                pass

    threading.Thread(target=answer, daemon=True).start()
    return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def test_without_a_run_the_error_names_endpoint_and_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConnectionRefusedError, match=rf"no run waits for programs at unix/{tmp_path}/s .*\$VCMVSP_SOCKETS"):
        connect("a", f"unix/{tmp_path}/s", timeout_s=0.0)
    monkeypatch.setenv("VCMVSP_SOCKETS", f"unix/{tmp_path}/other")
    with pytest.raises(ConnectionRefusedError, match=f"at unix/{tmp_path}/other "):
        connect("a", timeout_s=0.0)
    monkeypatch.setenv("VCMVSP_SOCKETS", "7550")
    with pytest.raises(ValueError, match="'7550': must be tcp/HOST:PORT"):
        connect("a", timeout_s=0.0)


@pytest.mark.parametrize("says", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", framed(Over()), GO, b"\x00\x00\x00\x09x"])
def test_a_listener_that_is_no_run_is_recognised(server: socket.socket, says: bytes) -> None:
    endpoint = serve(server, says)
    with pytest.raises(ConnectionError, match="is not a run that waits for programs"):
        connect("a", endpoint, timeout_s=0.0)


def test_a_refusal_contains_its_reason(server: socket.socket) -> None:
    with pytest.raises(ConnectionRefusedError, match="the run rejects the program of 'a': full"):
        connect("a", serve(server, framed(Refused("full"))))


@pytest.mark.parametrize("call", [lambda end: end.sleep(0.5), lambda end: end.recvfrom(0.1), lambda end: end.recvfrom()])
def test_a_lost_run_is_an_error_and_an_ended_one_is_run_over(server: socket.socket, call: Callable[[Socket], object]) -> None:
    for says, error in (((), ConnectionError), ((framed(Over()),), RunOver), ((WELCOME,), ConnectionError)):
        end = connect("a", serve(server, WELCOME, GO, *says))
        for _ in range(2):  # also on repetition
            with pytest.raises(error):
                call(end)
        end.close()


def test_unread_bytes_are_reported_to_the_run(server: socket.socket) -> None:
    messages = list[object]()

    def answer() -> None:
        end, _ = server.accept()
        with end:
            stream = Stream(end, 1 << 20)
            end.sendall(WELCOME + framed(Go(0, None, [(b"one", "b"), (b"three", "b")])))
            while (message := stream.receive()) is not None:
                messages.append(up(message))
                if isinstance(messages[-1], Wait):
                    end.sendall(framed(Go(5, (1.0, 2.0, 3.0), [])))

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    with connect("a", f"tcp/127.0.0.1:{server.getsockname()[1]}") as end:
        assert end.recvfrom() == (b"one", "b")
        end.sleep(1.0)
        assert (end.time_ns(), end.position()) == (5, (1.0, 2.0, 3.0))
        assert end.recvfrom(0.0) == (b"three", "b")
        with pytest.raises(TimeoutError):
            end.recvfrom(1e-9)
    with pytest.raises(ValueError, match="closed"):
        end.sendto(b"")
    thread.join(60.0)
    assert messages[1:] == [Wait(10**9, hears=False, held=517), Wait(1, hears=True, held=0)]


def test_a_run_that_does_not_wait_for_answers_is_an_error(server: socket.socket) -> None:
    end = connect("a", serve(server, WELCOME, GO, GO))
    for _ in range(2):  # also on repetition
        with pytest.raises(ConnectionError, match="without an answer to this program"):
            end.recvfrom()
    end.close()


@settings(max_examples=30)
@given(
    st.lists(st.binary(max_size=40) | st.just(GO) | st.just(framed(Go(9, None, [(b"x", "b")]))) | st.just(WELCOME), max_size=4),
    st.sampled_from([None, 0.1]),
)
def test_any_bytes_from_a_run_give_a_connection_error(pieces: list[bytes], timeout: float | None) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = serve(server, WELCOME, GO, *pieces)
        with pytest.raises(ConnectionError), connect("a", endpoint) as end:  # noqa: PT012  number of calls varies
            while True:
                try:
                    end.recvfrom(timeout)
                except TimeoutError:
                    end.sendto(b"again")


def test_a_program_loads_nothing_of_the_simulator() -> None:
    heavy = ("numpy", "simpy", "zenoh", "pyarrow")
    code = f"import sys, vcmvsp.cosim.sockets; print([each for each in {heavy} if each in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
