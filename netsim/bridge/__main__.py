"""``python -P -m vcmvsp.netsim.bridge FD [WARY]``, FD: the inherited end of the link to the run, which handles Ctrl-C."""

import contextlib
import gc
import os
import resource
import signal
import socket
import sys
from pathlib import Path

from vcmvsp.cosim.processes.child_process import LocalLink
from vcmvsp.netsim.bridge.bridge_process import BridgeProcess
from vcmvsp.netsim.bridge.datagram_store import new_loop
from vcmvsp.netsim.bridge.messages import WARY

NICE = -5  # where the system allows it: datagrams leave at their time while the run computes


def main() -> int:
    """Serve until the run ends; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(NICE)
        Path("/proc/self/autogroup").write_text(str(NICE))  # where sessions, of which this is one, share the processor evenly
    with contextlib.suppress(OSError, ValueError):  # a socket for each pair of vehicles
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    gc.collect()
    gc.freeze()  # objects created so far are permanent: exclude them from collections
    loop = new_loop()
    try:
        return loop.run_until_complete(
            BridgeProcess(LocalLink(socket.socket(fileno=int(sys.argv[1]))), loop, wary=WARY in sys.argv).serve()
        )
    finally:
        loop.close()


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # a thread of a gateway must not keep the process
