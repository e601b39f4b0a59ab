"""Sequences of the READMEs' commands in one folder, as printed or shortened."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from tests.support.docs.readme_pages import block

BRIEF, HERE = "--set duration_s=1 --set agents.deadline_s=20", "--agents inprocess"  # agents of a busy machine may be late
NO_ROBOT = "there is no robot at this port, so the scenario is checked instead, which connects to nothing"
ONE_EACH = f"{BRIEF} --seeds 1 --jobs 1"


@dataclass(frozen=True)
class Step:
    """A command, word for word from a README.

    Args:
        command: of a shell line, or within a sentence.
        shorter: additions so that it takes a second.
        instead: replaced words, and their replacements.
        why: of a replacement.
    """

    command: str
    shorter: str = ""
    instead: Mapping[str, str] = field(default_factory=dict)
    why: str = ""


@dataclass(frozen=True)
class Story:
    """Commands in order, in one folder.

    Args:
        name: of the test.
        steps: the commands.
        files: initial files of the folder, by name.
    """

    name: str
    steps: tuple[Step, ...]
    files: Mapping[str, str] = field(default_factory=dict)


def survey() -> str:
    """A log of levels at ten distances, by a law with an exponent of 2.5."""
    rows = [f"{n},0,0,1,{d},0,1,{-40.0 - 25.0 * n / 10 + (n % 3) - 1}" for n, d in enumerate(10 ** (k / 10) for k in range(20))]
    return "\n".join(["time,ax,ay,az,bx,by,bz,rssi_dbm", *rows, ""])


def plant() -> str:
    """A building of 20 m by 10 m."""
    ring = [[0.0, 0.0], [0.00018, 0.0], [0.00018, 0.00009], [0.0, 0.00009], [0.0, 0.0]]
    building = {"type": "Feature", "properties": {"building": "yes"}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    return json.dumps({"type": "FeatureCollection", "features": [building]})


KEEP_GAP = {"keep_gap.py": block("README.md", "class KeepGap"), "gap.toml": block("README.md", "# gap.toml")}
MINE = {
    "my_follower.py": block("docs/tutorial.md", "class MyFollower"),
    "mine.toml": block("docs/tutorial.md", "# mine.toml"),
}
CARS = {"cars.csv": "x,y,z\n0,0,0\n10,0,0\n0,20,0\n400,0,0\n"}
PATHS = {"paths.csv": "t,name,x,y,z\n0,base,0,0,1\n0,car1,0,5,1\n30,car1,300,5,1\n"}

CANYON = {
    "canyon.toml": block("docs/explanation/rays.md", "# canyon.toml"),
    "points.csv": block("docs/explanation/rays.md", "x,y,z"),
}

STORIES = (
    Story(
        "paths of rays",
        (
            Step("vcmvsp run canyon.toml", f"{HERE} --set duration_s=1"),
            Step("vcmvsp radio canyon.toml --coverage car1 --out rays.png", "--resolution 10"),
            Step("vcmvsp radio canyon.toml --paths points.csv --out paths.parquet"),
        ),
        CANYON,
    ),
    Story(
        "a run and what is made of it",
        (
            Step("vcmvsp run formation-circle", f"{HERE} --set duration_s=2"),
            Step("vcmvsp report runs/formation-circle-1"),
            Step("vcmvsp plot runs/formation-circle-1 --pdf --svg"),
            Step("vcmvsp export runs/formation-circle-1 --rosbag2 --csv --mp4 --layout"),
            Step("vcmvsp radio runs/formation-circle-1 --link car1/car2 --frame lost"),
            Step("vcmvsp radio formation-circle --coverage car1 --out map.png"),
        ),
    ),
    Story(
        "a study that goes on",
        (
            Step("vcmvsp study study-loss-delay --out both", f"{ONE_EACH} --vary radio.delay.seconds=0,1"),
            Step("vcmvsp study study-loss-delay --out both --resume", f"{ONE_EACH} --vary radio.delay.seconds=0,1,2"),
        ),
    ),
    Story(
        "a study of ones own grid",
        (
            Step(
                "vcmvsp study formation-slalom --vary radio.loss.probability=0:0.8:0.2"
                " --vary agents.estimator=hold,dr,acc,plan --seeds 20 --out remedies",
                ONE_EACH,  # of two --seeds the last counts
            ),
        ),
    ),
    Story(
        "a study of one key",
        (Step("vcmvsp study formation-slalom --vary radio.loss.probability=0:0.8:0.2 --seeds 20 --out slalom", ONE_EACH),),
    ),
    Story(
        "an agent of ones own",
        (
            Step("vcmvsp run gap.toml --agents process", BRIEF),
            Step("vcmvsp new agent follow-wall"),
            Step("vcmvsp reference radio.loss"),
        ),
        KEEP_GAP,
    ),
    Story(
        "a scenario of ones own",
        (
            Step("vcmvsp list"),
            Step("vcmvsp list scenarios"),
            Step("vcmvsp show formation-circle > mine.toml"),
            Step("vcmvsp check mine.toml"),
            Step("vcmvsp run mine.toml", f"{HERE} {BRIEF}"),
            Step("vcmvsp reference --json-schema > scenario.schema.json"),
            Step("vcmvsp show vehicle p2dx"),
            Step("vcmvsp world plant.geojson"),
        ),
        {"plant.geojson": plant()},
    ),
    Story(
        "a robot in software",
        (
            Step("vcmvsp run hybrid-formation", BRIEF),
            Step("vcmvsp replay runs/hybrid-formation-1"),
            Step("vcmvsp run hybrid-formation --twin", BRIEF),
            Step(
                "vcmvsp run hybrid-formation --set vehicle.car3.driver.port=/dev/ttyUSB0",
                instead={"run": "check"},
                why=NO_ROBOT,
            ),
            Step("vcmvsp emulate amigobot --port PTY", "--duration 0.2"),
            Step(
                "vcmvsp emulate amigobot --port tcp://:8101 --pose=-0.866,0.5,0 --ubisense udp://127.0.0.1:5010",
                "--duration 0.2",
                instead={"tcp://:8101": "tcp://:0"},
                why="the port may be taken",
            ),
            Step(
                "vcmvsp run hybrid-formation --set vehicle.car3.driver.port=tcp://127.0.0.1:8101",
                instead={"run": "check"},
                why=NO_ROBOT,
            ),
            Step(
                "vcmvsp run hybrid-formation --set vehicle.car3.driver.port=tcp://127.0.0.1:8101"
                " --set vehicle.car3.localisation.kind=none",
                instead={"run": "check"},
                why=NO_ROBOT,
            ),
            Step("vcmvsp new driver NAME", instead={"NAME": "crawler"}, why="the reader's name"),
        ),
    ),
    Story(
        "the tutorial",
        (
            Step("vcmvsp run formation-circle --set agents.estimator=hold --out hold", f"{HERE} {BRIEF}"),
            Step(
                "vcmvsp run formation-circle --set agents.estimator=hold --set radio.loss.probability=0.6 --out hold-60",
                f"{HERE} --set duration_s=2",
            ),
            Step("vcmvsp radio hold-60 --link car1/car2 --frame lost"),
            Step("vcmvsp run mine.toml --set agents.gain=3", BRIEF),
            Step(
                "vcmvsp study mine.toml --vary radio.loss.probability=0:0.6:0.3 --vary agents.gain=1,3 --seeds 3"
                " --out mine-study",
                ONE_EACH,
            ),
        ),
        MINE,
    ),
    Story(
        "an own metric",
        (Step("vcmvsp study mine.toml --vary radio.loss.probability=0:0.8:0.2 --metric own.late_share", ONE_EACH),),
        {
            **MINE,
            "mine.toml": f"{MINE['mine.toml']}\n{block('docs/howto/own-metric.md', 'late_share =')}",
            "shares.py": block("docs/howto/own-metric.md", "def above("),
        },
    ),
    Story("on a page", (Step("vcmvsp run recon-urban --view", f"{BRIEF} --view-port 0"),)),
    Story("in Foxglove", (Step("vcmvsp run recon-urban --foxglove", f"0 {BRIEF}"),)),
    Story(
        "the channel alone",
        (
            Step("vcmvsp channel --preset wifi-b-1 --positions cars.csv --rate 10 --size 100 --duration 30"),
            Step(
                "vcmvsp channel --preset wifi-b-1 --positions cars.csv --rate 10 --size 100 --duration 30"
                " --set path_loss.exponent=2"
            ),
            Step(
                "vcmvsp channel --preset wifi-g-6 --positions cars.csv --traffic jitter --jitter 0.1"
                " --rate 10 --size 100 --duration 30"
            ),
            Step("vcmvsp channel --preset wifi-g-6 --positions cars.csv --traffic saturated --to v0 --size 1000 --duration 5"),
            Step("vcmvsp channel --preset wifi-g-6 --positions paths.csv --traffic poisson --rate 10 --size 100 --duration 30"),
            Step("vcmvsp per --preset wifi-g-54 --model nist --snr 14:24:0.5 --size 100"),
            Step("vcmvsp per --preset wifi-g-6 --model nist --snr -2:6:0.5 --size 100"),
            Step("vcmvsp pathloss --preset zigbee --distance 1:100:1"),
            Step("vcmvsp pathloss --preset wifi-b-1 --distance 10:100:10"),
            Step("vcmvsp calibrate links.csv"),
        ),
        {**CARS, **PATHS, "links.csv": survey()},
    ),
    Story(
        "a world of ones own",
        (Step("vcmvsp world my_worlds.py:Orchard --set rows=4 --png orchard.png"),),
        {"my_worlds.py": block("docs/howto/own-world.md", "class Orchard")},
    ),
    Story("figures", (Step("vcmvsp figure"),)),
)
