"""Target recognition in aerial pictures, and the probability map of a search: cells, evidence, decisions."""

from vcmvsp.agents.reconnaissance.ground_point import Nadir, turned
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor, decisions
from vcmvsp.agents.reconnaissance.recognition import ground, inspection
from vcmvsp.agents.reconnaissance.recognition.detector import Detection, Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture
from vcmvsp.agents.reconnaissance.search_map import of_picture
from vcmvsp.agents.reconnaissance.watch import Watch, WatchFrame, Watching
from vcmvsp.physics.sensors.camera import Camera
from vcmvsp.physics.world.floor import PlacedTarget
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import Scene
