"""``vcmvsp`` that leaves no figures: a program of its own, most of whose time would go into them if it is a short run."""

import sys
from types import ModuleType

from vcmvsp.cosim.cli.app import main
from vcmvsp.cosim.runs.result import Result

Result._figures = lambda result, shown: {}  # type: ignore[assignment, method-assign]
for name in ("style", "run_plots"):  # to import what draws takes as long as the short run
    sys.modules[f"vcmvsp.cosim.plots.{name}"] = ModuleType(name)

if __name__ == "__main__":
    main()
