"""Existing programs on the emulated radio, over UDP: one asks, one answers, and the time there and back is measured."""

import contextlib
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
SECONDS = float(sys.argv[2]) if len(sys.argv) > 2 else 6.0  # of questions
PERIOD_S, FIRST_PORT = 0.1, 18500
QUESTIONS = round(SECONDS / PERIOD_S)
SCENARIO: dict[str, Any] = {
    "name": "udp",
    "duration_s": SECONDS + 1.0,
    "physics": {"kind": "kinematic"},
    "radio": {"preset": "wifi-b-1", "loss": {"probability": 0.1}, "delay": {"seconds": 0.04, "jitter_s": 0.02}},
    "bridge": {"udp": {"first_port": FIRST_PORT}},
    "vehicles": {"kind": "kinematic"},
    "vehicle": [{"name": "car1"}, {"name": "car2", "position": [20.0, 0.0, 0.0]}],
}
"""Ports, as the run prints them: car1's radio takes datagrams for car2 at 18502 and delivers to 18599; car2's, to 18699."""


def answer(door: socket.socket, over: threading.Event) -> None:
    """The program beside car2: whatever it hears, it sends back."""
    while not over.is_set():
        with contextlib.suppress(TimeoutError):
            question, sender = door.recvfrom(2048)
            door.sendto(question, sender)


def ask(door: socket.socket) -> list[float | None]:
    """The program beside car1: ask ten times a second; s until each answer, None if there was none."""
    waited: list[float | None] = []
    for number in range(QUESTIONS):
        begin = time.monotonic()
        door.sendto(str(number).encode(), ("127.0.0.1", FIRST_PORT + 2))
        waited.append(None)
        while (left := begin + PERIOD_S - time.monotonic()) > 0.0:
            door.settimeout(left)
            with contextlib.suppress(TimeoutError):
                earlier = int(door.recv(2048))
                waited[earlier] = time.monotonic() - begin + PERIOD_S * (number - earlier)
    return waited


def main() -> None:
    """Start the run, let both programs talk, and draw."""
    doors = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for door, port in zip(doors, (FIRST_PORT + 99, FIRST_PORT + 199), strict=True):
        door.bind(("127.0.0.1", port))
        door.settimeout(0.2)
    begun, over = threading.Event(), threading.Event()
    run = threading.Thread(
        target=vcmvsp.run, args=(SCENARIO,), kwargs={"seed": 1, "mcap": False, "progress": lambda *_: begun.set()}
    )
    echo = threading.Thread(target=answer, args=(doors[1], over))
    run.start()
    echo.start()
    begun.wait(30.0)
    waited = ask(doors[0])
    over.set()
    for each in (run, echo):
        each.join()
    for door in doors:
        door.close()

    answered = [each for each in waited if each is not None]
    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
    asked_s = [PERIOD_S * n for n, each in enumerate(waited) if each is not None]
    took_ms = [1e3 * each for each in answered]
    axes.plot(asked_s, took_ms, "o", label="answered")
    silent = [PERIOD_S * n for n, each in enumerate(waited) if each is None]
    axes.plot(silent, [0.0] * len(silent), "rx", label=f"no answer: {len(silent)} of {QUESTIONS}")
    axes.axhline(80.0, color="0.7", linestyle=":", label="delay of the radio, there and back")
    axes.set(
        xlabel="time of the question (s)",
        ylabel="there and back (ms)",
        title="UDP over an emulated radio: 10 % loss and 40 ms each way",
    )
    axes.set_ylim(-5.0, 150.0)
    axes.legend(loc="upper right", ncols=3, fontsize="small")
    figure.savefig(FOLDER / "udp_programs.png", dpi=120)


if __name__ == "__main__":
    main()
