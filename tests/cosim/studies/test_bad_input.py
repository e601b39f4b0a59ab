"""Bad studies through the command line: exit code 2 and one line with place and problem; nothing is run or written."""

from pathlib import Path

import pytest

from tests.support.cosim.command_line import two_cars, vcmvsp_command
from tests.support.cosim.studies import LOSS, mine

pytestmark = pytest.mark.processes

LOSSY = ("--vary", f"{LOSS}=0,0.5")
GRID = ("--vary", f"{LOSS}=0:0.99:0.01", "--vary", "agents.k1=0:1:0.01")  # of 10,100 points


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(two_cars())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ["nothing is varied", "e.g. --vary radio.loss.probability=0,0.2"]),
        (("--vary", "radio.loss.probabilty=0,1"), ["--vary radio.loss.probabilty=0", "did you mean 'probability'?"]),
        (("--vary", f"{LOSS}=0,2"), [f"--vary {LOSS}=2", "must be a number >= 0 and <= 1, not 2"]),
        (("--vary", f"{LOSS}=0,nan"), [f"--vary {LOSS}=nan", "must be finite"]),
        (("--vary", f"{LOSS}=0.5,5e-1"), [f"{LOSS} is varied over 0.5 twice"]),
        ((*GRID, "--vary", "agents.estimator=hold,hodl"), ["--vary agents.estimator=hodl"]),
        ((*LOSSY, *LOSSY), ["already varied"]),
        (("--vary", f"{LOSS}=0:1"), [f"--vary {LOSS}=0:1", "start:stop:step"]),
        (("--vary", "vehicle.car9.kind=lag,p2dx"), ["unknown vehicle 'car9'", "car1, car2"]),
        (("--vary", "seed=1,2"), ["seed cannot be varied", "--seeds"]),
        ((*LOSSY, "--set", f"{LOSS}=0.1"), ["both set and varied"]),
        ((*LOSSY, "--set", "duration_s=-1"), ["--set duration_s=-1", "duration_s"]),
        ((*LOSSY, "--seeds", "0"), ["--seeds 0"]),
        ((*LOSSY, "--jobs", "0"), ["--jobs 0"]),
        ((*LOSSY, "--seed", "-1"), ["--seed -1"]),
        ((*LOSSY, "--seed", str(2**63 - 1), "--seeds", "2"), ["--seed plus --seeds"]),
        ((*LOSSY, "--seeds", "1000000"), ["more than 1000000 runs"]),
        ((*LOSSY, "--metric", "formation.rms"), ["--metric formation.rms", "did you mean 'formation.rms_m'?"]),
        ((*LOSSY, "--metric", "digest"), ["unknown metric"]),
        ((*LOSSY, "--metric", "note.age_s"), ["[metrics.own] age_s = { note = 'age_s' }", "--metric own.age_s"]),
        ((*LOSSY, "--jobs", "2", "--cluster", "tcp://127.0.0.1:1"), ["--jobs and --cluster"]),
        ((*LOSSY, "--cluster", "nowhere"), ["--cluster nowhere", "tcp://"]),
        ((*LOSSY, "--resume", "--force", "--out", "o"), ["--resume (continue) and --force"]),
        ((*LOSSY, "--resume"), ["--resume needs --out"]),
        ((*LOSSY, "--out", "."), ["--out"]),
        ((*LOSSY, "--out", "s.toml"), ["--out s.toml", "is a file"]),
        ((*LOSSY, "--out", "full"), ["--out full", "not empty"]),
        ((*LOSSY, "--out", "full", "--resume"), ["--out full", "contains no study"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_is_refused(tmp_path: Path, arguments: tuple[str, ...], words: list[str]) -> None:
    before = sorted(tmp_path.rglob("*"))
    out = () if "--out" in arguments or arguments[-1:] == ("--resume",) else ("--out", "new")
    found = vcmvsp_command("study", "s.toml", *arguments, *out, "--quiet")
    assert (found.code, found.out) == (2, ""), found
    assert found.err.startswith("vcmvsp: ")
    assert found.err.count("\n") == 1, found.err
    assert [word for word in words if word not in found.err] == [], found.err
    assert sorted(tmp_path.rglob("*")) == before


def test_an_unknown_scenario_is_named() -> None:
    found = vcmvsp_command("study", "formation-cirle", *LOSSY)
    assert found.code == 2
    assert "did you mean 'formation-circle'?" in found.err


def test_a_study_table_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(
        two_cars(tail=f'[study]\nvary = {{ "{LOSS}" = [0, 1] }}\nseeds = 2\nmetrics = ["radio.frames"]')
    )
    found = vcmvsp_command("study", "t.toml", "--jobs", "1", "--quiet", "--json")
    assert found.code == 0, found
    assert '"runs": 4' in found.out
    assert '"radio.frames": {' in found.out
    assert (tmp_path / "runs" / "t-study" / "study.parquet").exists()
    again = vcmvsp_command("study", "t.toml", "--jobs", "1", "--quiet", "--json")
    assert again.out == found.out.replace("runs/t-study", "runs/t-study-2")


def test_without_a_folder_a_bad_study_makes_none(tmp_path: Path) -> None:
    assert vcmvsp_command("study", "s.toml", "--vary", f"{LOSS}=0,2").code == 2
    assert not (tmp_path / "runs").exists()


def test_a_study_of_failed_runs_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "no.py").write_text(
        "from vcmvsp import Agent\nclass No(Agent):\n    def act(self, obs, radio):\n        1 / 0\n"
    )
    (tmp_path / "n.toml").write_text(two_cars(agent='kind = "no.py:No"'))
    found = vcmvsp_command("study", "n.toml", *LOSSY, "--seeds", "1", "--jobs", "1", "--out", "o")
    assert found.code == 1
    assert "every run failed, the first with: agent no.py:No of vehicle car2" in found.err
    assert "ZeroDivisionError" in found.err
    assert (tmp_path / "o" / "report.html").exists()


@pytest.mark.parametrize("options", [(), ("--quiet",), ("--json",), ("--quiet", "--json")])
def test_failed_runs_are_reported_in_the_last_line(options: tuple[str, ...], tmp_path: Path) -> None:
    scenario = str(mine(tmp_path))
    grid = ("--vary", "agents.nap_s=0", "--seeds", "3", "--set", "vehicle.car1.agent.bad_seed=1", "--metric", "radio.frames")
    found = vcmvsp_command("study", scenario, *grid, "--jobs", "1", "--out", "o", *options)
    assert found.code == 1
    last = found.err.splitlines()[-1]
    assert last.startswith("vcmvsp: 1 of 3 runs failed, the first with: agent mine.py:Mine of vehicle car1")
    assert (tmp_path / "o" / "report.html").exists()
    assert ("results: o" in found.out) == (not options)
