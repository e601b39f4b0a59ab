"""``vcmvsp`` that leaves no figures: a program of its own, most of whose time would go into them if it is a short run."""

import sys
from types import ModuleType

from cosim.cli import main
from cosim.result import Result

Result._figures = lambda result, shown: {}  # type: ignore[assignment, method-assign]
sys.modules["cosim.record.plots"] = ModuleType("cosim.record.plots")  # to import what draws takes as long as the short run

if __name__ == "__main__":
    main()
