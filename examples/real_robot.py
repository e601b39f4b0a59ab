"""A real robot among simulated ones, here an emulated one behind a serial port. The run keeps to the wall clock."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import vcmvsp

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
SECONDS = float(sys.argv[2]) if len(sys.argv) > 2 else 12.0


def main() -> None:
    """Run with the emulated robot and with its simulated twin, and draw both."""
    figure, (paths, speeds) = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
    short = {"duration_s": SECONDS, "metrics.from_s": 0.0}
    real = vcmvsp.run("hybrid-formation", seed=1, set=short, agents="inprocess", mcap=False)
    twin = vcmvsp.run(
        "hybrid-formation", seed=1, set={**short, "vehicle.car3.driver.kind": "none"}, agents="inprocess", mcap=False
    )
    for result, style, what in ((real, "-", "emulated robot"), (twin, ":", "simulated twin")):
        for number, (name, path) in enumerate(result.states.to_pandas().groupby("vehicle", observed=True)):
            if name != "car3" and result is twin:
                continue  # the simulated ones drive alike
            paths.plot(
                path.x, path.y, style, color=f"C{number}", label=f"car3, {what}" if name == "car3" else f"{name}, simulated"
            )
            if name == "car3":
                speeds.plot(path.time_ns / 1e9, (path.vx**2 + path.vy**2) ** 0.5, style, color=f"C{number}", label=what)
    hardware = real.metrics["hardware"]["car3"]
    causes = ", ".join(f"{cause} {each:.1f} s" for cause, each in hardware["limited_by_s"].items())
    paths.set(xlabel="x (m)", ylabel="y (m)", title="Paths; of the emulated robot, its estimate", aspect="equal")
    speeds.set(
        xlabel="time (s)",
        ylabel="speed of car3 (m/s)",
    )
    speeds.set_title(f"The robot was held back by:\n{causes or 'nothing'}", fontsize="small")
    paths.legend(fontsize="small", loc="lower right")
    speeds.legend()
    figure.savefig(FOLDER / "real_robot.png", dpi=120)


if __name__ == "__main__":
    main()
