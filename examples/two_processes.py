"""Two processes that find each other over Zenoh: a run, and a host of one agent. It gives the bytes of one process."""

import json
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from pyarrow import parquet

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
VCMVSP = [sys.executable, "-m", "vcmvsp.cosim.cli.app"]
SETTINGS = ["--set", "agents.estimator=hold", "--set", "agents.runs=inprocess", "--set", "duration_s=25"]
RUN = [*VCMVSP, "run", "formation-circle", *SETTINGS, "--quiet"]


def free_port() -> int:
    """A free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def together(out: Path) -> None:
    """The run in this process' place, and car2's agent in another one, as if it were on another machine."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    remote = [
        "--set",
        "vehicle.car2.agent.runs=zenoh",
        "--set",
        f"agents.listen={endpoint}",
        "--set",
        "agents.deadline_s=20",
        "--out",
        str(out),
    ]
    run = subprocess.Popen([*RUN, *remote])
    host = subprocess.Popen([*VCMVSP, "agent", "--vehicle", "car2", "--connect", endpoint])
    try:
        if run.wait(timeout=120.0) or host.wait(timeout=60.0):
            raise SystemExit("the run or the host failed")
    finally:
        run.kill()
        host.kill()


def main() -> None:
    """Run once alone and once with a host, and draw both."""
    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    with tempfile.TemporaryDirectory() as name:
        alone, hosted = Path(name) / "alone", Path(name) / "hosted"
        subprocess.run([*RUN, "--out", str(alone)], check=True)
        together(hosted)
        digests = [json.loads((each / "metrics.json").read_text())["digest"][:12] for each in (alone, hosted)]
        for run, style, label in ((alone, "-", "one process"), (hosted, "k:", "car2's agent in another one")):
            states = parquet.read_table(run / "states.parquet").to_pandas().set_index(["time_ns", "vehicle"])
            gap = states.xs("car1", level=1)[["x", "y"]] - states.xs("car2", level=1)[["x", "y"]]
            axes.plot(gap.index / 1e9, (gap.x**2 + gap.y**2) ** 0.5, style, linewidth=2, label=label)
    axes.set(xlabel="time (s)", ylabel="distance of car2 from its leader (m)", title=f"Digests: {' and '.join(digests)}")
    axes.legend()
    figure.savefig(FOLDER / "two_processes.png", dpi=120)


if __name__ == "__main__":
    main()
