"""Stand-in for Betaflight's simulator target, as a separate program: fixed ports, no flight control.

It answers every packet but the first. Motor N in its own order turns at N tenths, with a remote control only while AUX 1 is
on. ``--stop`` is the simulated time of its end, s.
"""

import argparse
import math
import select
import socket
import struct
import sys


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stop", type=float, default=math.inf)
    stop_s = parser.parse_args().stop
    state, sticks = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    state.bind(("", 9003))
    sticks.bind(("", 9004))
    armed, first = True, True
    while True:
        ready, _, _ = select.select([state, sticks], [], [])
        if sticks in ready:
            armed = struct.unpack("<d16H", sticks.recv(4096))[5] > 1700  # the time comes first
        if state in ready:
            time_s, *_ = struct.unpack("<18d", state.recv(4096))
            if time_s >= stop_s:
                sys.exit("told to stop")
            pulses = [1000.0 + 100.0 * (n + 1) * armed for n in range(4)]
            if not first:
                state.sendto(struct.pack("<H2x16f", 4, *pulses, *[0.0] * 12), ("127.0.0.1", 9001))
            first = False


if __name__ == "__main__":
    main()
