"""A hundred quadrotors beside PyFlyt's (github.com/jjshoots/PyFlyt), which flies them in PyBullet too, in one run.

``python -m bench.drones``. Both step at 240 Hz, run their flight controllers at 120 Hz or more, and are given new velocities
and yaw rates ten times a second. CPU time of each process.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.measure import Row, in_turn, table
from bench.vehicles import Fleet, federate_cpu_s

ROUNDS = 3
COUNT = 100
RATE_HZ = 240.0
SPAN_S = 0.5  # of PyFlyt's flight in each round
PYTHON = Path(".drones/bin/python")  # with PyFlyt, which needs an older NumPy than we do: see the Makefile

_PYFLYT = """
import os, sys, time
answers = os.fdopen(os.dup(1), "w")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Bullet greets
import numpy as np
from PyFlyt.core import Aviary

count, span_s = int(sys.argv[1]), float(sys.argv[2])
places = np.array([(3.0 * (n % 10), 3.0 * (n // 10), 5.0) for n in range(count)])
model = {"drone_model": "primitive_drone"}  # of 1 kg; its Crazyflie costs as much
air = Aviary(places, np.zeros((count, 3)), "quadx", drone_options=model, seed=1)
air.set_mode(6)  # velocity over ground, yaw rate, climb
tenth = round(0.1 / air.step_period)

def fly(tenths):
    for _ in range(tenths):
        turn = 1.0 if int(air.elapsed_time) % 2 else -1.0
        air.set_all_setpoints(np.tile((turn, 0.5 * turn, 0.2, 0.0), (count, 1)))
        for _ in range(tenth):
            air.step()

fly(5)
for _ in sys.stdin:
    begin = time.process_time()
    fly(round(10 * span_s))
    cost = time.process_time() - begin
    height = np.array([air.state(n)[3, 2] for n in range(count)])
    assert air.physics_hz == 240 and np.all(abs(height - 5.0) < 1.0), height  # they do fly
    print(cost / span_s, file=answers, flush=True)
"""


@contextlib.contextmanager
def pyflyt(count: int) -> Iterator[Callable[[], float]]:
    """PyFlyt in the air; each call flies on and gives CPU seconds per simulated second."""
    if not PYTHON.exists():
        raise SystemExit(f"no PyFlyt to compare with: make {PYTHON.parts[0]}/.ready")
    command = [str(PYTHON), "-c", _PYFLYT, str(count), str(SPAN_S)]
    quiet = {**os.environ, "PYTHONWARNINGS": "ignore"}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=quiet) as child:
        assert child.stdin
        assert child.stdout
        asked, told = child.stdin, child.stdout

        def fly() -> float:
            asked.write("on\n")
            asked.flush()
            return float(told.readline())

        try:
            yield fly
        finally:
            asked.close()


def rows() -> list[Row]:
    """The one."""
    print("measuring: a hundred quadrotors beside PyFlyt ...", file=sys.stderr, flush=True)
    fleet = Fleet(0, COUNT, rate_hz=RATE_HZ)
    with pyflyt(COUNT) as other:
        mine, its, ratio = in_turn(lambda: federate_cpu_s(fleet), other, ROUNDS)
    name = f"{COUNT} quadrotors, {RATE_HZ:g} Hz; beside it PyFlyt 0.29 at its own 240 Hz"
    return [Row(name, f"{1.0 / mine:.1f}x real time", f"{1.0 / its:.2f}x", ratio, "<= 0.1", ratio <= 0.1)]


if __name__ == "__main__":
    print(table(rows()))
