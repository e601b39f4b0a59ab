"""Command that remakes the pictures of the documents: ``python -m tests.support.docs.pictures [NAME...]``, or ``make
pictures``.

Figures come from runs of the scenarios; pictures of the control station need a browser (Chromium).
"""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
from PIL import Image

from tests.support.cosim.view_pages import browser
from tests.support.paths import ROOT
from vcmvsp.cosim.export.video import FPS

FOLDER = ROOT / "scenarios" / "pictures"
VCMVSP = str(Path(sys.executable).with_name("vcmvsp"))
FIGURES = ("trajectory", "formation_error", "mission", "mosaic", "detections")
EXAMPLES = ("clocks", "relay-canyon")
CHANGED = {"relay-chain-none": ("relay-chain", ["--set", "routing.kind=none"])}
"""Scenario and options of runs that have another name."""
STATIONS = {"recon-urban": 75.0, "recon-team": 60.0, "lab-patrol": 20.0, "pillar-triangle": 12.0}
"""Time of the recording that is shown, s."""
FILM_S = 35.0  # time of the film's still
READY_MS, DRAWN_MS, SETTLED_MS = 60_000, 8_000, 2_000
COLORS = 192  # palette of a picture: half of its bytes


def main(names: Sequence[str]) -> None:
    """Make the named pictures, or all."""
    with tempfile.TemporaryDirectory() as folder:
        made: dict[str, Path] = {}
        for path in sorted(FOLDER.glob("*.png")):
            if names and path.stem not in names:
                continue
            scenario, _, picture = path.stem.rpartition("-")
            if path.stem == "demo":
                command(folder, "demo", "--out", "demo")
                shutil.copy(Path(folder, "demo", "comparison.png"), path)
            elif path.stem in EXAMPLES:
                name = path.stem.replace("-", "_")
                subprocess.run([sys.executable, ROOT / "examples" / f"{name}.py", folder], check=True)
                shutil.copy(Path(folder, f"{name}.png"), path)
            elif path.stem == "demo-film":
                command(folder, "demo", "--out", "demo")
                command(folder, "export", "demo/hold", "--mp4")
                film_still(Path(folder, "demo", "hold", "run.mp4"), path)
            elif picture in FIGURES or picture == "station":
                if scenario not in made:
                    name, options = CHANGED.get(scenario, (scenario, []))
                    command(folder, "run", name, *options, "--out", scenario)
                    made[scenario] = Path(folder, scenario)
                if picture == "station":
                    station(made[scenario], STATIONS[scenario], path)
                else:
                    shutil.copy(made[scenario] / f"{picture}.png", path)
            else:
                continue
            with Image.open(path) as drawn:
                drawn.convert("RGB").quantize(COLORS).save(path, optimize=True)
            sys.stdout.write(f"{path}\n")


def command(folder: str, *words: str) -> None:
    """Run a command of vcmvsp in a folder."""
    quiet = [] if words[0] == "export" else ["-q"]
    subprocess.run([VCMVSP, *words, *quiet], cwd=folder, check=True, stdout=subprocess.DEVNULL)


def film_still(film: Path, path: Path) -> None:
    """The picture of a film at `FILM_S`."""
    reader = cv2.VideoCapture(str(film))
    for _ in range(round(FILM_S * FPS)):
        reader.grab()
    _, picture = reader.retrieve()
    reader.release()
    cv2.imwrite(str(path), picture)


def station(run: Path, time_s: float, path: Path) -> None:
    """A picture of the page that shows a recording at a time."""
    process = subprocess.Popen([VCMVSP, "view", str(run), "--port", "0"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with browser() as started:
        page = started.new_page(viewport={"width": 1150, "height": 640})
        page.goto(process.stdout.readline().strip())
        page.get_by_role("button", name="Pause").click(timeout=READY_MS)
        page.get_by_role("button", name="Play").wait_for()
        page.get_by_role("textbox").first.fill(f"{time_s:g}")
        page.keyboard.press("Enter")
        page.wait_for_timeout(SETTLED_MS)
        page.get_by_role("button", name="Play").click()
        page.wait_for_timeout(DRAWN_MS)
        for scan in page.get_by_role("checkbox", name="scan").all():
            scan.check()
        page.get_by_role("button", name="Fit all").click()
        page.wait_for_timeout(SETTLED_MS)
        page.locator("#webgl-software-rendering button").click()
        page.wait_for_timeout(SETTLED_MS)
        page.screenshot(path=path)
    process.kill()
    process.wait()


if __name__ == "__main__":
    main(sys.argv[1:])
