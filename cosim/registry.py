"""From the ``kind`` of a scenario to a class: short names, ``module:Class``, or ``file.py:Class``.

Parts are reached only through here, as strings, so that ``import cosim`` stays light. Other distributions add short names
through the entry-point groups ``cosim.<group>``, e.g. ``cosim.agent``.
"""

import contextlib
import contextvars
import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from cosim.errors import ScenarioError, UsageError, place_of
from cosim.table import Named, Origin, unknown

PARTS = ("physics", "netsim", "agents", "hardware", "scenarios")

VERBS: Mapping[str, str] = {
    "physics": "step(now_ns, inbox)",
    "world": "build()",
    "vehicle": "radius_m",
    "sensor": "measure(scene, row, rng)",
    "agent": "act(obs, radio)",
    "estimator": "predict(report, age_s)",
    "avoidance": "decide(view, task)",
    "path_loss": "loss_db(paths)",
    "walls": "loss_db(paths)",
    "shadowing": "loss_db(paths)",
    "fading": "gain_db(frame, draw)",
    "phy": "air_time_ns(size_bytes)",
    "mac": "open(phy, count, keys, noise_mw)",
    "loss": "lost(frame, draw)",
    "delay": "delay_ns(frame, draw)",
    "script": "gain_db(frame, draw)",
    "trace": "level_dbm(frame)",
    "jammer": "interference_mw(start_ns, end_ns, rx, loss_db, where)",
    "delivery": "deliver(sender_row, rows, received_ns, size_bytes, draw)",
    "door": "deliver(sender, receiver, payload)",
    "routing": "open(vehicles, seed)",
    "driver": "write(velocity)",
    "localisation": "read(now_ns)",
}
"""What a class of each group must have."""

PIECES: Mapping[str, str] = {
    "agent host": "agents.federate:AgentHost",
    "host process": "agents.serve:host",
    "flies": "physics.vehicles:flies",
    "vehicle body": "physics.vehicles:body_of",
    "vehicle spec": "physics.vehicles:VehicleSpec",
    "positioning": "physics.positioning:Positioning",
    "world": "physics.world:World",
    "world pictures": "physics.draw",
    "mesh colors": "physics.mesh_colors:mesh_colors",
    "hull": "physics.bodies:hull_of",
    "least clearance": "physics.clearance:least_clearance_m",
    "radio": "netsim.federate:RadioFederate",
    "recorded radio": "netsim.recorded:RecordedChannel",
    "channel": "netsim.channel:Channel",
    "radio presets": "netsim.presets",
    "bridge": "netsim.bridge.federate:Bridge",
    "bridge playback": "netsim.bridge.playback:BridgePlayback",
    "networks": "netsim.bridge.ip_runs",
    "socket server": "netsim.sockets.federate:Programs",
    "radio paths": "netsim.layers:Paths",
    "radio frame": "netsim.layers:Frame",
    "radio links": "netsim.layers:Links",
    "calibration": "netsim.calibrate",
    "coverage": "netsim.coverage",
    "channel trial": "netsim.trial",
    "channel curves": "netsim.trial_curves",
    "positions file": "netsim.trial_positions:read_positions",
    "row file": "netsim.trial_rows:RowFile",
    "vehicle radio": "netsim.radios:Radio",
    "sightline": "physics.sightline:Sightline",
    "hardware": "hardware.federate:Hardware",
    "stations": "hardware.station.control",
    "safety check": "hardware.connecting:check_safety",
    "playback": "hardware.playback:Playback",
    "emulate options": "hardware.emulate.options",
    "emulated robot": "hardware.emulate.robot:emulate",
    "emulated vehicle": "hardware.emulate.scenario:emulate",
    "emulated tag": "hardware.emulate.robot:emulate_tag",
    "emulated autopilot": "hardware.emulate.autopilot:emulate",
    "emulated ros2 robot": "hardware.emulate.ros2:emulate",
    "fusion": "hardware.positioning.fusion:Fusion",
    "scene": "physics.scene",
    "reconnaissance": "agents.reconnaissance",
    "ground point": "agents.reconnaissance.ground_point",
    "watch": "agents.reconnaissance.watch",
    "looks of a picture": "agents.reconnaissance.search_map:of_picture",
    "recognition": "agents.reconnaissance.recognition",
    "recognition ground": "agents.reconnaissance.recognition.ground",
    "recognition inspection": "agents.reconnaissance.recognition.inspection",
}
"""Pieces of parts that are no kinds of a scenario, for `piece`."""

NOTHING = "cosim.component:nothing"
"""A kind of a layer that may be left out."""

KINDS: Mapping[str, Mapping[str, str]] = {
    "physics": {"bullet": "physics.federate:BulletPhysics", "kinematic": "physics.federate:KinematicPhysics"},
    "world": {
        "empty": "physics.worlds:Empty",
        "boxes": "physics.worlds:Boxes",
        "laboratory": "physics.worlds:Laboratory",
        "recreation-centre": "physics.worlds:RecreationCentre",
        "urban": "physics.worlds:Urban",
        "corridor": "physics.worlds:Corridor",
        "gates": "physics.worlds:Gates",
        "gates-offset": "physics.worlds:GatesOffset",
        "pillar": "physics.worlds:Pillar",
        "file": "physics.importers:File",
        "map": "physics.importers:Map",
        "geojson": "physics.importers:GeoJson",
        "mesh": "physics.importers:MeshFile",
    },
    "vehicle": {
        "p2dx": "physics.vehicles:P2DX",
        "amigobot": "physics.vehicles:AmigoBot",
        "quadrotor": "physics.quadrotor:Quadrotor",
        "point": "physics.vehicles:Point",
        "urdf": "physics.urdf:UrdfDrive",
        "urdf-quadrotor": "physics.urdf:UrdfQuadrotor",
        "kinematic": "physics.vehicles:Kinematic",
        "lag": "physics.vehicles:Lag",
        "inertial": "physics.vehicles:Inertial",
    },
    "sensor": {
        "range_scanner": "physics.scanner:RangeScanner",
        "lms": "physics.scanner:Lms",
        "ring": "physics.scanner:Ring",
        "camera": "physics.camera:Camera",
        "nadir_camera": "physics.camera:NadirCamera",
        "gps": "physics.sensors.gps:Gps",
        "uwb": "physics.sensors.uwb:Uwb",
        "imu": "physics.sensors.imu:InertialUnit",
        "wheel_odometry": "physics.sensors.odometry:WheelOdometry",
        "bumper": "physics.sensors.bumper:Bumper",
        "neighbour_range": "physics.sensors.neighbours:NeighbourRange",
        "altimeter": "physics.sensors.altimeter:Altimeter",
        "compass": "physics.sensors.compass:Compass",
        "positioning": "physics.sensors.positioning:PositioningSensor",
        "target_sensor": "physics.sensors.targets:TargetSensor",
    },
    "agent": {
        "trajectory": "agents.formation.trajectory:Trajectory",
        "route": "agents.formation.route:Route",
        "teleop": "agents.formation.teleop:Teleop",
        "leader_follower": "agents.formation.leader_follower:LeaderFollower",
        "consensus": "agents.formation.consensus:Consensus",
        "patrol": "agents.patrol:Patrol",
        "aerial_route": "agents.formation.aerial_route:AerialRoute",
        "aerial_follower": "agents.formation.aerial_follower:AerialFollower",
        "avoid": "agents.avoidance.avoid:Avoid",
        "search": "agents.reconnaissance.search:Search",
        "track": "agents.reconnaissance.track:Track",
        "mission": "agents.mission.mission:Mission",
    },
    "estimator": {},  # a parameter of agents, which know their own
    "avoidance": {},  # likewise
    "path_loss": {
        "log_distance": "netsim.propagation:LogDistance",
        "friis": "netsim.ground:Friis",
        "two_ray_ground": "netsim.ground:TwoRayGround",
        "none": "netsim.propagation:NoPathLoss",
    },
    "walls": {
        "itu": "netsim.materials:ItuWalls",
        "fixed": "netsim.materials:FixedWalls",
        "none": NOTHING,
    },
    "shadowing": {"gudmundson": "netsim.shadowing:Shadowing", "none": NOTHING},
    "fading": {
        "rayleigh": "netsim.fading:Rayleigh",
        "nakagami": "netsim.fading:Nakagami",
        "rician": "netsim.fading:Rician",
        "none": NOTHING,
    },
    "script": {"script": "netsim.script:Script", "none": NOTHING},
    "trace": {"trace": "netsim.trace:Trace", "none": NOTHING},
    "jammer": {"jammer": "netsim.jammer:Jammer", "none": NOTHING},
    "phy": {
        "constant_rate": "netsim.phy:ConstantRate",
        "dsss": "netsim.phy:Dsss",
        "ofdm": "netsim.phy_ofdm:Ofdm",
        "ieee802154": "netsim.phy:Ieee802154",
    },
    "mac": {"ideal": "netsim.mac:Ideal", "dcf": "netsim.dcf:Dcf", "csma154": "netsim.csma154:Csma154"},
    "loss": {
        "bernoulli": "netsim.loss:Bernoulli",
        "gilbert_elliott": "netsim.burst:GilbertElliott",
        "bursts": "netsim.bursts:Bursts",
        "none": "netsim.loss:NoLoss",
    },
    "driver": {
        "arcos": "hardware.arcos.driver:ArcosDriver",
        "bench": "hardware.bench:Bench",
        "zenoh": "hardware.onboard.driver:ZenohDriver",
        "ros2": "hardware.ros2.driver:Ros2Driver",
        "mavlink": "hardware.mavlink.driver:MavlinkDriver",
    },
    "localisation": {
        "ubisense": "hardware.positioning.sources:Ubisense",
        "dwm1001": "hardware.positioning.sources:Dwm1001",
        "nmea": "hardware.positioning.sources:Nmea",
        "zenoh": "hardware.positioning.pose_topic:ExternalPose",
    },
    "door": {
        "udp": "netsim.bridge.udp:Udp",
        "wss": "netsim.bridge.wss:Wss",
        "ip": "netsim.bridge.ip:Ip",
        "zenoh": "netsim.bridge.zenoh:ZenohDoor",
    },
    "routing": {
        "flooding": "netsim.routing.flooding:Flooding",
        "static": "netsim.routing.static:Static",
        "distance_vector": "netsim.routing.distance_vector:DistanceVector",
        "none": NOTHING,
    },
    "delivery": {"delivery": "netsim.delivery:Delivery", "none": NOTHING},
    "delay": {
        "fixed": "netsim.delay:FixedDelay",
        "uniform": "netsim.random_delay:UniformDelay",
        "normal": "netsim.random_delay:NormalDelay",
        "gamma": "netsim.random_delay:GammaDelay",
        "empirical": "netsim.random_delay:EmpiricalDelay",
        "none": "netsim.delay:NoDelay",
    },
}


_folder: contextvars.ContextVar[Path | None] = contextvars.ContextVar("folder", default=None)


SHIPPED = Path(__file__).resolve().parent.parent / "scenarios"
"""The built-in scenarios, and the files that come with them."""


def located(name: str, folder: Path | None = None) -> Path:
    """Where a file is that a scenario names: beside it, or else among those that come with the built-in scenarios.

    Args:
        name: as it is written.
        folder: the scenario's; default: that of `looking_in`, or the current one.
    """
    own, shipped = ((each / name).resolve() for each in (folder or _folder.get() or Path(), SHIPPED))
    return shipped if shipped.is_file() and not own.exists() else own


@contextlib.contextmanager
def looking_in(folder: Path) -> Iterator[None]:
    """While something is built: where the files are that it names itself, in its parameters."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def find(group: str, kind: str, *, folder: Path | None = None, key: str = "kind", origin: Origin | None = None) -> Any:
    """The class that ``kind`` names.

    Args:
        group: what it is looked up as, e.g. ``"agent"``.
        kind: short name, ``module:Class`` or ``file.py:Class``.
        folder: where a relative file is looked for (the scenario's folder); default: that of `looking_in`, or the current one.
        key: path of the kind in the scenario, for messages.
        origin: where the scenario came from, for messages.

    Raises:
        ScenarioError: there is no such kind, or what it names cannot be imported.
    """
    origin = origin or Named()
    aim = target(group, kind, key=key, origin=origin)
    where, _, name = aim.rpartition(":")
    path = file_of(kind, folder or _folder.get()).resolve() if is_file_kind(kind) else None
    if path and not path.is_file():
        raise ScenarioError(f"there is no file {path}", key=key, source=origin.of(key))
    try:
        module = load_file(path) if path else importlib.import_module(where)
    except (Exception, SystemExit) as error:
        problem = f"'{where}' cannot be imported: {type(error).__name__}: {error}{place_of(error)}"
        raise ScenarioError(problem, key=key, source=origin.of(key)) from error
    found = getattr(module, name, None)
    if found is None:
        raise ScenarioError(f"'{where}' has no class '{name}'", key=key, source=origin.of(key))
    if aim != NOTHING and not (callable(found) and hasattr(found, VERBS[group].partition("(")[0])):
        problem = f"'{kind}' is no {group.replace('_', '-')}: it has no {VERBS[group]}"
        raise ScenarioError(problem, key=key, source=origin.of(key))
    return found


def piece(name: str) -> Any:
    """A piece of a part that the core needs (see `PIECES`)."""
    module, _, attribute = PIECES[name].partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, attribute) if attribute else loaded


def target(group: str, kind: str, *, key: str = "kind", origin: Origin | None = None) -> str:
    """``module:Class`` or ``file.py:Class`` of a kind that may be a short name."""
    if ":" in kind:
        return kind
    if kind in KINDS[group]:
        return KINDS[group][kind]
    others = _entry_points(group)  # looks through all installed distributions: only where it must
    if kind not in others:
        names = [*KINDS[group], *others]
        problem = unknown(f"{group.replace('_', '-')} kind", kind, names) + "; or give module:Class or file.py:Class"
        raise ScenarioError(problem, key=key, source=(origin or Named()).of(key))
    return others[kind]


def file_of(kind: str, folder: Path | None) -> Path:
    """The Python file of a ``file.py:Class`` kind."""
    return (folder or Path()) / kind.rpartition(":")[0]


def is_file_kind(kind: str) -> bool:
    """Whether a kind names a file rather than a module or a short name."""
    return kind.rpartition(":")[0].endswith(".py")


def load_file(path: Path) -> ModuleType:
    """Import a Python file by its path, afresh; modules beside it can be imported by it."""
    name = f"_vcmvsp_{path.stem}_{hashlib.blake2b(str(path).encode(), digest_size=6).hexdigest()}"
    loader = importlib.machinery.SourceFileLoader(name, str(path))
    spec = importlib.machinery.ModuleSpec(name, loader, origin=str(path))
    spec.has_location = True  # so that the module has a __file__, by which its source is found
    module = importlib.util.module_from_spec(spec)
    before = {*sys.modules, name}
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
        for other in [each for each in sys.modules if each not in before and _lies_in(sys.modules[each], path.parent)]:
            del sys.modules[other]  # what it imported from beside it is its own, and is read afresh next time
    return module


def _lies_in(module: ModuleType, folder: Path) -> bool:
    file = getattr(module, "__file__", None)
    return file is not None and Path(file).resolve().is_relative_to(folder)


def guard() -> None:
    """Refuse to go on if a part would come from elsewhere than beside this package.

    Other distributions install top-level packages called ``agents`` or ``hardware`` too, and a folder of that name in the
    current directory comes first on the path of a notebook.
    """
    home = Path(__file__).resolve().parent.parent
    for part in PARTS:
        spec = importlib.util.find_spec(part)
        places = [Path(place).resolve() for place in (spec.submodule_search_locations or ())] if spec else []
        if places != [home / part]:
            found = str(places[0]) if places else "nowhere"
            raise UsageError(
                f"the package '{part}' of vcmvsp is expected at {home / part} but Python finds it at {found}; "
                "start elsewhere, remove that package, or install vcmvsp in an environment of its own"
            )


def _entry_points(group: str) -> dict[str, str]:
    return {entry.name: entry.value for entry in importlib.metadata.entry_points(group=f"cosim.{group}")}
