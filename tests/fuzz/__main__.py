"""``python -m tests.fuzz``: commands with damaged and odd input, each of which must answer with one message.

A case fails with a traceback, an exit code that is not documented, more than 10 s of processor time or 1 GiB, or a file outside
``--out``. Each is named by a command that shows it again.
"""

import argparse
import contextlib
import gc
import importlib
import os
import pkgutil
import shlex
import sys
import tempfile
from pathlib import Path

import vcmvsp
from tests.fuzz import forked, mutations
from vcmvsp.cosim.cli import app

PROGRESS_EVERY = 500  # cases


def fuzz() -> int:
    parser = argparse.ArgumentParser("python -m tests.fuzz", description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument("--cases", type=int, default=300, help="how many [300]")
    parser.add_argument("--first", type=int, default=0, help="number of the first case, to go on with a seed [0]")
    parser.add_argument("--seed", type=int, default=0, help="of all cases [0]")
    parser.add_argument("--case", type=int, help="only this one, with its command and what it says")
    parser.add_argument("--keep", type=Path, help="folder for the files of that case")
    chosen = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory(prefix="vcmvsp-fuzz-") as name:
        results = _whole_run(Path(name))
        _import_all()
        os.environ["VCMVSP_FIGURES"] = "0"  # `plot` and `report` draw; a run's figures would take 1 s
        numbers = range(chosen.first, chosen.first + chosen.cases) if chosen.case is None else [chosen.case]
        for number in numbers:
            folder = (chosen.keep or Path(name)) / str(number) / "case"
            folder.mkdir(parents=True)
            words = mutations.make(number, chosen.seed, folder, results)
            found = forked.problems(words, folder)
            if found or chosen.case is not None:
                said = folder.with_name("said").read_text("utf-8", "replace").splitlines()[-3:]
                _say(f"python -m tests.fuzz --seed {chosen.seed} --case {number}: vcmvsp {shlex.join(words)[:500]}")
                _say(*(f"    {each}" for each in found), *(f"    | {each[:300]}" for each in said))
            failed += bool(found)
            if number % PROGRESS_EVERY == PROGRESS_EVERY - 1:
                _say(f"{number + 1 - chosen.first} of {len(numbers)} cases, {failed} failed")
    _say(f"{failed} of {len(numbers)} cases failed (seed {chosen.seed})")
    return bool(failed)


def _say(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def _whole_run(folder: Path) -> Path:
    (folder / "whole").mkdir()
    (folder / "whole" / "s.toml").write_text(mutations.SMALL, "utf-8")
    found = forked.problems(["run", "s.toml", "--out", "out"], folder / "whole")
    assert not found, found
    assert (folder / "whole" / "out").is_dir(), (folder / "said").read_text("utf-8")
    return folder / "whole" / "out"


def _import_all() -> None:
    """Import all modules once, so that no case pays for it."""
    for module in pkgutil.walk_packages(vcmvsp.__path__, "vcmvsp."):
        if not module.name.endswith("__main__") and "reproduction" not in module.name:
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)
    importlib.import_module("pydantic.type_adapter")  # for typer
    app.command()  # is kept
    gc.freeze()  # a collection in a forked process would copy all that it visits


if __name__ == "__main__":
    sys.exit(fuzz())
