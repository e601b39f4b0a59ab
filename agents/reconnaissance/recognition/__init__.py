"""Recognition of targets in pictures from above, by colour, by what turning does not change, and by correlation.

`template`: what is looked for; `colour`, `polar`, `match`: the three stages; `detector`: all of them. The
answer to a call depends on its arguments alone. Vehicles, cameras and maps do not belong here.
"""

from vcmvsp.agents.reconnaissance.recognition.detector import Detection, Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture

__all__ = ["Detection", "Detector", "TargetPicture"]
