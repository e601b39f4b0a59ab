"""Recognition of targets in pictures from above, by colour, by what turning does not change, and by correlation.

`template`: what is looked for; `colour`, `polar`, `match`: the three stages; `detector`: all of them; `calibration`: how far it
is to be trusted. The answer to a call depends on its arguments alone.
"""

from agents.reconnaissance.recognition.calibration import Calibration, Seen, Truth, calibrate
from agents.reconnaissance.recognition.detector import Detection, Detector
from agents.reconnaissance.recognition.template import Target

__all__ = ["Calibration", "Detection", "Detector", "Seen", "Target", "Truth", "calibrate"]
