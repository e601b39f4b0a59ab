"""Recognition of targets in pictures from the air: cameras, detector and its stages, synthetic pictures."""

from vcmvsp.agents.reconnaissance.ground_point import Nadir, turned
from vcmvsp.agents.reconnaissance.recognition import ground, inspection
from vcmvsp.agents.reconnaissance.recognition.detector import Detection, Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture
from vcmvsp.agents.reconnaissance.watch import Watch, WatchFrame, Watching
from vcmvsp.physics.sensors.camera import Camera
from vcmvsp.physics.world.floor import PlacedTarget
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import Scene

__all__ = [
    "Camera",
    "Detection",
    "Detector",
    "Hull",
    "Nadir",
    "PlacedTarget",
    "Scene",
    "TargetPicture",
    "Watch",
    "WatchFrame",
    "Watching",
    "ground",
    "inspection",
    "turned",
]
