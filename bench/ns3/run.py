"""``python -m bench.ns3.run``: passes its options to the compiled ``wifi.cc`` (``--help`` lists them)."""

import os
import sys

from bench.ns3.program import program

if __name__ == "__main__":
    os.execv(program(), [str(program()), *sys.argv[1:]])
