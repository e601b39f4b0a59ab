"""Every block of a README is used by a test, or is listed as no code; its tables are those of a scenario."""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.docs.readme_coverage import SHOWN
from tests.support.docs.readme_pages import CODE, INDENTED, Block
from tests.support.docs.readme_pages import block as block_of
from tests.support.docs.readme_sessions import KEEP_GAP
from tests.support.netsim.bridge_runs import VehiclesAtRest
from tests.support.paths import ROOT
from vcmvsp.cosim.federate import RunInfo

DO = (
    "A block in a README that is neither a scenario nor for a shell is used by a test (`tests.support.docs.readme_pages`)."
    " Name it in SHOWN in tests/support/docs/readme_coverage.py, or say there why there can be none."
)
CARS = """
[[vehicle]]
name = "car1"
kind = "p2dx"
agent = { kind = "trajectory", path = "straight" }
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-2.0, 0.0, 0.0]
agent = { kind = "leader_follower", leader = "car1" }
"""
TEAM = CARS.replace(', leader = "car1"', "")  # the formation sets the leader
SEARCHERS = "\n".join(
    f'[[vehicle]]\nname = "uav{n}"\nkind = "quadrotor"\nposition = [{10 * n}.0, 0.0, 30.0]\nagent = {{}}\n'
    'sensors = { scan = { kind = "ring" }, camera = { kind = "nadir_camera" } }\n'
    for n in (1, 2, 3)
)


@dataclass(frozen=True)
class Completion:
    """Text that completes a block to a scenario.

    Args:
        after: tables behind the block.
        before: tables in front of it.
        files: contents of files that it names, by name.
    """

    after: str = ""
    before: str = ""
    files: Mapping[str, str | bytes] = field(default_factory=dict)


FIRMWARE = '[physics]\nrate_hz = 400.0\n[[vehicle]]\nname = "uav1"\nkind = "quadrotor"\n'
AROUND = {
    ("netsim/bridge/README.md", "[bridge.fast]"): Completion(
        before='[[radio]]\nname = "wifi"\n[[radio]]\nname = "lora"\n' + CARS
    ),
    ("docs/howto/firmware.md", "--defaults {folder}/copter.parm"): Completion(before=FIRMWARE),
    ("docs/howto/firmware.md", 'kind = "px4"'): Completion(before=FIRMWARE),
    ("docs/howto/firmware.md", 'kind = "betaflight"'): Completion(before=FIRMWARE),
    ("docs/howto/firmware.md", "mavlink ="): Completion(before=FIRMWARE),
    ("docs/tutorial.md", "# mine.toml"): Completion(files={"my_follower.py": block_of("docs/tutorial.md", "class MyFollower")}),
    ("README.md", "# gap.toml"): Completion(files={"keep_gap.py": KEEP_GAP["keep_gap.py"]}),
    ("docs/reference/agents.md", 'changes = [[30.0, "column"]'): Completion(TEAM),
    ("docs/reference/agents.md", "lookahead_m = 1.2"): Completion(CARS.replace('kind = "p2dx"\n', "")),
    ("docs/reference/agents.md", 'kind = "avoid", avoidance = { kind = "gap" }'): Completion(
        before='[[vehicle]]\nname = "car1"\nkind = "amigobot"\nsensors = { scan = { kind = "lms" } }\n'
    ),
    ("docs/reference/agents.md", "[agents.formation.passage]"): Completion(
        TEAM.replace('kind = "p2dx"', 'kind = "p2dx"\nsensors = { scan = { kind = "lms" } }'),
        before='[agents.formation]\nshape = "wedge"\n',
    ),
    ("docs/reference/agents.md", "[agents.algorithms.search]"): Completion(SEARCHERS),
    ("hardware/README.md", 'kind = "arcos"'): Completion(CARS),
    ("netsim/README.md", "path_loss = { exponent = 2.5 }"): Completion(
        '[[vehicle]]\nname = "car2"\nposition = [5.0, 0.0, 0.0]\n[vehicles]\nkind = "p2dx"\n'
    ),
    ("physics/README.md", 'picture = "mine.png"'): Completion(
        CARS, files={"mine.png": (ROOT / "scenarios" / "targets" / "bravo.png").read_bytes()}
    ),
    ("docs/howto/own-vehicle.md", 'kind = "urdf"'): Completion(
        files={"cart.urdf": block_of("docs/howto/own-vehicle.md", "<robot name=")}
    ),
}
"""By page, and words in the block; without an entry: two cars, if the block has no vehicle."""


def is_table(block: Block) -> bool:
    return block.language == "toml" or (block.language == INDENTED and block.text.startswith("["))


def entries(block: Block, listed: Any) -> list[Any]:
    """Values of the listed entries that match a block."""
    return [each for (page, words), each in listed.items() if page == block.page and words in block.text]


@pytest.mark.parametrize("block", [each for each in CODE if not entries(each, SHOWN)], ids=str)
def test_every_table_is_valid_in_a_scenario(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_table(block), f"{block}: {block.text}{DO}"
    monkeypatch.chdir(tmp_path)
    (around,) = entries(block, AROUND) or [Completion("" if "[[vehicle]]" in block.text else CARS)]
    for name, content in around.files.items():
        Path(name).write_bytes(content.encode() if isinstance(content, str) else content)
    head = "" if "\nduration_s =" in block.text else 'name = "shown"\nduration_s = 100.0\n'
    Path("shown.toml").write_text(head + around.before + block.text + around.after)
    code, _, err = vcmvsp_command("check", "shown.toml")
    assert code == 0, f"{block}: {err} If it is a part of a scenario, say in AROUND what is around it."


@pytest.mark.parametrize("listed", [SHOWN, AROUND], ids=["shown", "around"])
def test_listed_blocks_are_still_in_a_readme(listed: Any) -> None:
    found = {key: [str(each) for each in CODE if entries(each, {key: 0})] for key in listed}
    assert [key for key, blocks in found.items() if not blocks] == []
    assert [blocks for (page, _), blocks in found.items() if len(blocks) > 1 and page != "scenarios/README.md"] == []


def test_the_custom_federate() -> None:
    run = RunInfo(scenario="own", seed=1, duration_ns=10**9, vehicles=("car1", "car2"))
    names = {"MyFederate": VehiclesAtRest, "run_info": run, "inputs": []}
    exec(compile(block_of("cosim/README.md", "check_federate("), "README.md", "exec", dont_inherit=True), names)


def test_the_call_of_a_study_on_slurm_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a cluster: its calls are recorded, and the arguments of the study are checked against its signature."""
    calls: list[tuple[Any, ...]] = []
    signature = inspect.signature(vcmvsp.study)

    class Cluster:
        def __init__(self, **options: Any) -> None:
            calls.append(("cluster", options["processes"]))

        def scale(self, *, jobs: int) -> None:
            calls.append(("jobs", jobs))

    package = ModuleType("dask_jobqueue")
    package.SLURMCluster = Cluster  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "dask_jobqueue", package)
    monkeypatch.setattr(vcmvsp, "study", lambda *args, **options: calls.append(signature.bind(*args, **options).args[:1]))
    exec(compile(block_of("docs/howto/cluster.md", "SLURMCluster("), "README.md", "exec", dont_inherit=True), {})
    assert calls == [("cluster", 1), ("jobs", 100), ("formation-slalom",)]
