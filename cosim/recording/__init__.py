"""What a run leaves: `run.mcap`, the rows of its tables, the log of external inputs; and reading it back.

No figures (`cosim.plots`), no other formats (`cosim.export`), no effect on the run.

Start reading at `recorder`.
"""

from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.tables.schema import Placement, Recording, load

__all__ = ["Placement", "Recorder", "Recording", "load"]
