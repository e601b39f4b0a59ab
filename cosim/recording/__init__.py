"""What a run leaves: two tables, a recording for Foxglove and Lichtblick, metrics and figures. Start reading at `recorder`."""

from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.tables.schema import Placement, Recording, load

__all__ = ["Placement", "Recorder", "Recording", "load"]
