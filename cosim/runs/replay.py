"""Replay a recorded run, in logical time and as fast as possible; unchanged it gives the same bytes.

Poses, estimates and readings of real vehicles come from the recording, independent of new commands. Algorithms and simulated
vehicles run anew. A replay shows what a changed algorithm would have done with the recorded observations, but not what the
robot would have done then, unless its simulated twin replaces it. Agents of lost hosts take part again, and agents of hosts
with other code run this machine's code: `comparison` reports both.
"""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.external_inputs import FILE
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json

RADIO_FILE = "radio.parquet"


def replay(
    run_dir: str | Path,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    agents: Mapping[str, Any] | str | None = None,
    twin: bool = False,
    radio: str = "drawn",
    out: str | Path | None = None,
    force: bool = False,
    **options: Any,
) -> api.Result:
    """Replay a recorded run from its folder.

    Args:
        seed: replaces the run's.
        set: changed keys of its scenario, as for `vcmvsp.run`.
        agents: agents as objects, or where all run.
        twin: simulated vehicles of the same kinds replace the real ones.
        radio: ``"drawn"``: frame outcomes are drawn again from the models, equal for equal seed and inputs;
            ``"recorded"``: frame outcomes are repeated, see `netsim.channel.replayed`.
        out: folder to write into.
        force: write into a folder that is not empty.
        options: further arguments of `vcmvsp.run`.

    Raises:
        UsageError: the folder lacks what a replay needs.
    """
    folder = Path(run_dir)
    check(folder, out, radio)
    scenario = folder / "scenario.toml"
    parsed, _ = scenarios.load(scenario)
    real = parsed.real
    settings = {**(parsed.twins if twin else {}), **(set or {})}
    loaded = scenarios.load(scenario, settings=settings, seed=seed)
    driven = [name for name in loaded.scenario.real if twin or name not in real]
    if driven:
        raise UsageError(
            f"--set: a replay cannot add drivers, and {', '.join(driven)} was not real in {folder}: leave them out"
        )
    if twin and not real:
        raise UsageError(f"--twin: no vehicle of {folder} was real; leave the option out")
    outside = () if twin else real
    remedy = ": replay with simulated vehicles (--twin)" if outside else ""
    if parsed.bridge.doors or parsed.stack:
        outside += ("its programs",)
    if outside and not (folder / FILE).is_file():
        raise UsageError(f"{folder} has no {FILE} with the inputs of {', '.join(outside)}{remedy}")
    recorded_radio = folder / RADIO_FILE if radio == "recorded" else None
    return api.run(
        loaded,
        agents=agents,  # type: ignore[arg-type]  # `run` checks them
        out=out,
        force=force,
        playback=folder if outside else None,
        recorded_radio=recorded_radio,
        **options,
    )


def comparison(run_dir: str | Path, result: api.Result) -> tuple[bool, str]:
    """Compare an unchanged replay with its run: whether no difference was found, and a line that says so."""
    before, about = (_content(Path(run_dir) / name) for name in ("metrics.json", "about.json"))
    if "digest" not in before or about.get("error"):
        return True, f"not compared: {run_dir} is incomplete"
    if before["digest"] == result.metrics["digest"]:
        return True, f"same digest as {run_dir}"
    causes = list(map(str, about.get("unrepeatable", ())))
    then, now = about.get("versions", {}), result.about["versions"]
    causes += [f"{name} was {then[name]}, is {now.get(name)}" for name in then if then[name] != now.get(name)]
    return False, f"differs from {run_dir}: {'; '.join(causes) or 'no recorded cause'}"


def beside(run_dir: Path) -> Path:
    """Default folder of a replay: ``NAME-replay`` beside the run ``NAME``."""
    folder = run_dir if run_dir.name not in ("", "..") else run_dir.resolve()
    return folder.with_name(f"{folder.name}-replay")


def _content(path: Path) -> dict[str, Any]:
    """Content of a run's JSON file; empty if it is missing or damaged."""
    with contextlib.suppress(OSError, ValueError):
        content: dict[str, Any] = read_json(limits.read_bytes(path), dict[str, Any])
        return content
    return {}


def check(folder: Path, out: str | Path | None, radio: str) -> None:
    """Reject a folder that lacks files for the replay, and the folder itself as output."""
    if not (folder / "scenario.toml").is_file():
        problem = "there is no such folder" if not folder.is_dir() else "has no scenario.toml"
        raise UsageError(f"{folder}: {problem}; name the folder of a run (runs/NAME-SEED, or its --out)")
    if radio not in ("drawn", "recorded"):
        raise UsageError(f"--radio {radio}: must be drawn or recorded")
    if radio == "recorded" and not (folder / RADIO_FILE).is_file():
        raise UsageError(f"{folder} has no {RADIO_FILE} with its receptions: replay with --radio drawn")
    if out is not None and Path(out).resolve() == folder.resolve():
        raise UsageError(f"--out {out}: is the replayed run itself; choose another folder")
