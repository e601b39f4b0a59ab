"""What a run leaves: two tables, a recording for Foxglove and Lichtblick, metrics and figures. Start reading at `recorder`."""

from cosim.record.recorder import Recorder
from cosim.record.tables import Placement, Recording, load

__all__ = ["Placement", "Recorder", "Recording", "load"]
