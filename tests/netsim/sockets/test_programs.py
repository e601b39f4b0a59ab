"""Programs that leave, hang, or send invalid data: the run goes on, or ends with one error that names the program."""

import contextlib
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.netsim.socket_programs import PATIENCE_S, by_hand, chat, idle, run_programs, scenario
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.sockets import Socket
from vcmvsp.cosim.sockets.messages import MOST_UP, VERSION, Hello, Send, Wait, framed
from vcmvsp.cosim.types import Note

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


def notes_of(events: list[Any]) -> list[tuple[str, int, dict[str, Any]]]:
    return [(each.key, each.time_ns, each.value.values) for each in events if isinstance(each.value, Note)]


def test_a_program_that_ends_leaves_its_vehicle_silent_and_the_run_goes_on(tmp_path: Path) -> None:
    tenths, events, lines = list[int](), list[Any](), list[str]()

    def brief(end: Socket) -> None:
        end.sleep(0.25)
        end.sendto(b"farewell")

    def listen(end: Socket) -> None:
        for data, _ in end:
            assert data in (b"farewell", b"here")
            tenths.append(end.time_ns() // 10**8)

    content, plays = scenario(tmp_path, "a", "b", "c"), {"a": listen, "b": brief, "c": chat}
    result = run_programs(content, plays, mcap=False, observe=events.append, tell=lines.append)
    assert result.about["simulated_s"] == 1.0
    assert tenths == [0, 1, 2, 2, 3, 4, 5, 6, 7, 8, 9]
    assert notes_of(events) == [("b/note", 250_000_000, {"program": "left: it has ended"})]
    assert lines[-1] == "the program of b disconnected at 0.250 s (it has ended)"


@pytest.mark.parametrize("waits", [True, False])
def test_a_program_that_is_killed_is_missed_at_once(tmp_path: Path, waits: bool) -> None:
    content, events = scenario(tmp_path, "a", "b"), list[Any]()
    code = f"""if True:
        import sys, time
        from vcmvsp.cosim.sockets import connect
        with connect("b", sys.argv[1]) as end:
            end.sleep(0.25)
            print("now", flush=True)
            {"end.sleep(9.0)" if waits else "time.sleep(60.0)"}
    """
    victim = subprocess.Popen([sys.executable, "-c", code, content["sockets"]["listen"]], stdout=subprocess.PIPE)

    def kill() -> None:
        assert victim.stdout is not None
        victim.stdout.readline()
        victim.send_signal(signal.SIGKILL)
        victim.wait()

    def killer(end: Socket) -> None:
        end.sleep(0.5)
        kill()
        end.sleep(0.01)
        chat(end)

    if not waits:
        threading.Thread(target=kill, daemon=True).start()
    try:
        result = run_programs(content, {"a": killer if waits else chat}, mcap=False, observe=events.append)
    finally:
        victim.kill()
        victim.communicate()
    assert notes_of(events) == [("b/note", 510_000_000 if waits else 250_000_000, {"program": "left: it has ended"})]
    assert result.about["simulated_s"] == 1.0
    assert result.metrics["radio"]["frames"] == (5 if waits else 10)


NONSENSE = {
    "noise": b"\x00\x00\x00\x04\xc1\xc1\xc1\xc1",
    "another type": b"\x00\x00\x00\x01\x2a",
    "too long": (MOST_UP + 1).to_bytes(4, "big") + b"x",
    "negative time": framed(Wait(-1, hears=False, held=0)),
    "no time": framed(Wait(0, hears=True, held=0)),
    "endless time": framed(Wait(10**18 + 1, hears=True, held=0)),
    "held": framed(Wait(None, hears=True, held=2**40)),
    "to itself": framed(Send("b", b"")),
    "to nobody": framed(Send("\x1b]0;owned\x07", b"")),
    "long datagram": framed(Send(None, bytes(65_536))),
    "hello again": framed(Hello(VERSION, "b")),
    "nested": (5000).to_bytes(4, "big") + b"\x91" * 5000,
    "two waits": framed(Wait(10, hears=False, held=0)) * 2,
}


@pytest.mark.parametrize("nonsense", NONSENSE.values(), ids=NONSENSE)
def test_invalid_data_count_as_leaving(tmp_path: Path, nonsense: bytes) -> None:
    lines, received = list[str](), list[Any]()

    def liar() -> None:
        with by_hand(tmp_path, "b") as end:
            end.sendall(framed(Send("a", b"sense")) + nonsense)
            while end.recv(1 << 16):
                pass

    thread = threading.Thread(target=liar, daemon=True)
    thread.start()
    result = run_programs(scenario(tmp_path, "a", "b"), {"a": received.extend}, mcap=False, tell=lines.append)
    thread.join(PATIENCE_S)
    assert result.about["simulated_s"] == 1.0
    assert [data for data, _ in received] in ([b"sense"], [])  # earlier lines may arrive after those that separate them
    assert lines[-1].startswith("the program of b disconnected at 0.000 s (it s")
    assert lines[-1].isprintable()


@settings(max_examples=10)
@given(
    st.lists(
        st.binary(max_size=30) | st.builds(lambda n: framed(Wait(n, hears=True, held=0)), st.integers(1, 10**9)), max_size=5
    )
)
def test_no_bytes_disturb_the_run(tmp_path_factory: pytest.TempPathFactory, pieces: list[bytes]) -> None:
    path = tmp_path_factory.mktemp("s")

    def fuzz() -> None:
        with by_hand(path, "b") as end:
            for piece in pieces:
                end.sendall(piece)

    threading.Thread(target=fuzz, daemon=True).start()
    result = run_programs(scenario(path, "a", "b", duration_s=0.2), {"a": chat}, mcap=False)
    assert result.metrics["radio"]["frames"] == 2


def test_a_program_that_speaks_while_it_should_wait_leaves(tmp_path: Path) -> None:
    lines, request, request_sent = list[str](), threading.Event(), threading.Event()

    def eager() -> None:
        with by_hand(tmp_path, "b") as end:
            end.sendall(framed(Wait(None, hears=False, held=0)))
            request.wait(PATIENCE_S)
            end.sendall(framed(Send(None, b"!")))
            request_sent.set()
            while end.recv(1 << 16):
                pass

    def play(end: Socket) -> None:
        end.sleep(0.5)
        request.set()
        request_sent.wait(PATIENCE_S)
        end.sleep(0.01)
        chat(end)

    threading.Thread(target=eager, daemon=True).start()
    result = run_programs(scenario(tmp_path, "a", "b"), {"a": play}, mcap=False, tell=lines.append)
    assert lines[-1] == "the program of b disconnected at 0.510 s (it sent out of turn)"
    assert result.metrics["radio"]["frames"] == 5


def test_a_program_that_sends_without_end_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcmvsp.netsim.sockets.federate.MOST_CALLS", 50)
    lines = list[str]()

    def endless(end: Socket) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                end.sendto(b"me me me", "a")

    result = run_programs(scenario(tmp_path, "a", "b"), {"a": idle, "b": endless}, mcap=False, tell=lines.append)
    assert "without waiting" in lines[-1]
    assert result.metrics["radio"]["frames"] == 51


def test_unread_data_are_lost_beyond_four_mebibytes(tmp_path: Path) -> None:
    numbers, events, lines = list[int](), list[Any](), list[str]()

    def late(end: Socket) -> None:
        end.sleep(0.5)
        end.sleep(0.1)
        while True:
            try:
                numbers.append(end.recvfrom(0)[0][0])
            except TimeoutError:
                break
        numbers.append(end.recvfrom()[0][0])

    def flood(end: Socket) -> None:
        for number in range(100):
            end.sleep(0.001)
            end.sendto(bytes([number]) * 65_535, "a")
        end.sleep(0.6)
        end.sendto(b"\xff", "a")

    content = scenario(tmp_path, "a", "b")
    run_programs(content, {"a": late, "b": flood}, mcap=False, observe=events.append, tell=lines.append)
    room = (4 << 20) // (65_535 + 512)
    assert numbers == [*range(room), 255]
    missed = [(time_ns, values["program_missed"]) for _, time_ns, values in notes_of(events) if "program_missed" in values]
    assert [count for _, count in missed] == [float(each) for each in range(1, 101 - room)]
    assert all(room * 1_000_000 < time_ns < 102_000_000 for time_ns, _ in missed)  # on arrival, not on wake-up
    assert sum("reads too slowly" in line for line in lines) == 1


def test_a_program_that_hangs_ends_the_run_with_its_name(tmp_path: Path) -> None:
    def hang() -> None:
        with by_hand(tmp_path, "b") as end:
            end.sendall(framed(Wait(300_000_000, hears=False, held=0)))
            while end.recv(1 << 16):
                pass

    content = scenario(tmp_path, "a", "b", sockets={"deadline_s": 2.0})
    threading.Thread(target=hang, daemon=True).start()
    with pytest.raises(FederateError, match=r"program of b: did not wait or end within 2 s \(sockets.deadline_s\)") as caught:
        run_programs(content, {"a": chat}, mcap=False)
    assert caught.value.result.about["simulated_s"] == 0.3
    assert caught.value.result.metrics["radio"]["frames"] == 3  # at 0, 0.1 and 0.2 s


SPEAKER = '''
from vcmvsp import Agent

class Speaker(Agent):
    """Says bytes and a mapping in turn; notes what it hears."""
    def act(self, obs, radio):
        for heard in obs.heard:
            self.note(heard=repr(heard.message.body))
        radio.send(b"bytes") if obs.time_ns % 200_000_000 else radio.send(x=1.0)
'''


def test_agents_and_programs_hear_the_bytes_of_one_another(tmp_path: Path) -> None:
    (tmp_path / "speaker.py").write_text(SPEAKER)
    content, received, events = scenario(tmp_path, "a", "b"), list[Any](), list[Any]()
    content["vehicle"][1]["agent"] = {"kind": f"{tmp_path}/speaker.py:Speaker"}
    content["sockets"]["vehicles"] = ["a"]

    def play(end: Socket) -> None:
        end.sendto(b"hello", "b")
        received.extend((*each, end.time_ns() // 10**8) for each in end)

    run_programs(content, {"a": play}, mcap=False, observe=events.append)
    assert received == [(b"bytes", "b", tenth) for tenth in (1, 3, 5, 7, 9)]
    assert notes_of(events) == [("b/note", 100_000_000, {"heard": "b'hello'"})]
