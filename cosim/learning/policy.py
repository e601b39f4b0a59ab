"""Trained policies: files of a network, and the agent `Policy` that runs one in any run, process, machine or robot."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.learning.mail import Mail
from vcmvsp.cosim.learning.sensors import SensorVector
from vcmvsp.cosim.learning.task import Floats, Layout, Task, Worlds
from vcmvsp.cosim.learning.tasks import TASKS
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Velocity
from vcmvsp.cosim.util.files import replacing

META = "vcmvsp"
"""Key of a file's `PolicyMeta`: an array of bytes in ``.npz``, a custom entry of the metadata of ``.onnx``."""
FAR_M = 1e9  # place of other vehicles in the state that a policy observes: unknown


class PolicyMeta(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a policy was trained for."""

    task: str
    vehicles: int
    settings: dict[str, Any] = {}  # fields of the task, such as its greatest speed


def meta_of(task: Task, layout: Layout) -> PolicyMeta:
    """The description of policies of a task."""
    fields = {name: value for name, value in vars(task).items() if not name.startswith("_")}
    return PolicyMeta(task.name, layout.vehicles, fields)


class Network:
    """A policy: a function of one observation (size,) that gives one action (a,) in [-1, 1].

    A file ``.npz`` has matrices ``w0``, ``w1``, ... (inputs, outputs) and vectors ``b0``, ``b1``, ..., with tanh after each
    layer, also the last, and optionally ``scale`` (size,), by which observations are multiplied. A file ``.onnx`` takes an
    array (1, size) of float32 and gives (1, a); it needs onnxruntime.
    """

    def __init__(self, meta: PolicyMeta, compute: Callable[[Floats], Floats]) -> None:
        self.meta, self._compute = meta, compute

    def __call__(self, observation: NDArray[Any]) -> Floats:
        """The action (a,) of an observation (size,)."""
        return np.clip(self._compute(observation), -1.0, 1.0)

    def check(self, task: Task, vehicles: int, where: str) -> None:
        """Refuse a policy of another task or another number of vehicles.

        Raises:
            UsageError: it is one; ``where`` names the file.
        """
        meta = self.meta
        if (meta.task, meta.vehicles) != (task.name, vehicles):
            trained, target = f"{meta.task} with {meta.vehicles} vehicles", f"{task.name} with {vehicles}"
            raise UsageError(f"{where}: trained for the task {trained}, not for {target}")


def layers_of(arrays: Mapping[str, NDArray[Any]]) -> Callable[[Floats], Floats]:
    """The function of a file's matrices and vectors.

    Raises:
        ValueError: they do not fit together, or are not finite.
    """
    pairs = [(arrays[f"w{number}"].astype(float), arrays[f"b{number}"].astype(float)) for number in range(len(arrays) // 2)]
    if not pairs or any(w.ndim != 2 or b.shape != w.shape[1:] for w, b in pairs):
        raise ValueError("needs matrices w0, w1, ... (inputs, outputs) and vectors b0, b1, ... (outputs,)")
    if any(layer[0].shape[1] != next_layer[0].shape[0] for layer, next_layer in pairwise(pairs)):
        raise ValueError("the outputs of a layer must be the inputs of the next one")
    scale = arrays.get("scale", np.ones(len(pairs[0][0]))).astype(float)
    if scale.shape != (len(pairs[0][0]),) or not all(np.isfinite(each).all() for each in arrays.values()):
        raise ValueError("all numbers must be finite, and scale must have a number for each input")

    def compute(observation: Floats) -> Floats:
        value = np.asarray(observation, float) * scale
        for w, b in pairs:
            value = np.tanh(value @ w + b)
        return value

    return compute


def save_network(path: Path, layers: Sequence[tuple[Floats, Floats]], meta: PolicyMeta, scale: Floats | None = None) -> None:
    """Write a policy as ``.npz``; ``layers``: matrices (inputs, outputs) and vectors (outputs,)."""
    arrays = {f"{name}{number}": array for number, pair in enumerate(layers) for name, array in zip("wb", pair, strict=True)}
    if scale is not None:
        arrays["scale"] = scale
    described = np.frombuffer(msgspec.json.encode(meta), np.uint8)
    with replacing(path) as place, place.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, **{META: described})


def load_network(path: str | Path) -> Network:
    """Read a policy of a file ``.npz`` or ``.onnx``.

    Raises:
        UsageError: the file cannot be read or is no policy.
    """
    path = Path(path)
    try:
        return _onnx(path) if path.suffix == ".onnx" else _npz(path)
    except UsageError:
        raise
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    except Exception as error:  # readers of archives and networks raise many kinds
        raise UsageError(f"{path}: is no policy, neither .npz nor .onnx ({type(error).__name__})") from error


def _npz(path: Path) -> Network:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if META not in arrays:
        raise UsageError(f"{path}: is no policy: it has no entry '{META}' (vcmvsp.policy.save_network writes one)")
    meta = msgspec.json.decode(arrays.pop(META).tobytes(), type=PolicyMeta)
    try:
        return Network(meta, layers_of(arrays))
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _onnx(path: Path) -> Network:
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise UsageError(f"{path}: needs onnxruntime: pip install onnxruntime") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # sums do not depend on the number of cores
    session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    described = session.get_modelmeta().custom_metadata_map.get(META)
    if described is None:
        raise UsageError(f"{path}: is no policy: its metadata have no entry '{META}' with task and vehicles as JSON")
    name = session.get_inputs()[0].name

    def compute(observation: Floats) -> Floats:
        row = np.asarray(observation, np.float32)[None]
        return np.asarray(session.run(None, {name: row})[0][0], float)

    return Network(msgspec.json.decode(described, type=PolicyMeta), compute)


def task_of_meta(meta: PolicyMeta, kind: type[Task] | None = None) -> Task:
    """The task with the settings of its training.

    Raises:
        ValueError: there is no such task, or it has no such settings.
    """
    if kind is None and meta.task not in TASKS:
        raise ValueError(f"trained for the task '{meta.task}': derive an agent from vcmvsp.policy.Policy and set task_class")
    task = (kind or TASKS[meta.task])()
    for name, value in meta.settings.items():
        if not hasattr(task, name):
            raise ValueError(f"the task {task.name} has no setting '{name}'")
        setattr(task, name, tuple(value) if isinstance(value, list) else value)
    return task


class Policy(Agent):
    """Runs a trained policy: it observes, sends and moves as in the environment that it was trained in.

    With the true pose it gives the same actions as in `vcmvsp.env.parallel_env`. For a custom task, derive a class with
    its ``task_class``.

    Args:
        file: trained policy, .npz or .onnx.
    """

    task_class: ClassVar[type[Task] | None] = None

    def __init__(self, file: Path) -> None:
        self._file = file
        try:
            self._network = load_network(file)
            self._task = task_of_meta(self._network.meta, self.task_class)
        except (UsageError, ValueError) as error:
            raise ScenarioError(str(error).removeprefix(f"{file}: "), key="file") from error
        self.sensors = self._task.sensors

    def start(self, info: VehicleInfo) -> None:
        """Prepare; the vehicles of the run must be as many as in the training."""
        try:
            self._network.check(self._task, len(info.vehicles), str(self._file))
        except UsageError as error:
            raise ValueError(str(error)) from error
        n, task = len(info.vehicles), self._task
        self._row, self._names = info.vehicles.index(info.name), {name: row for row, name in enumerate(info.vehicles)}
        rng = stream(info.seed, f"task/{task.name}")
        starts = task.starts(rng)
        memory = task.begin(rng, np.zeros((n, 4)) if starts is None else starts)
        self._memory = {name: np.asarray(value)[None] for name, value in memory.items()}
        self._mail = Mail(1, n, task.message_floats)
        self._layout: Layout | None = None
        self._bounds: Any = None
        self._sensors: SensorVector

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """The command of the network's action; the message is sent if it says so."""
        task, row = self._task, self._row
        self._mail.put_received(obs.heard, row, self._names)
        worlds = self._worlds(obs)
        if obs.time_ns:
            task.step(worlds)
        features = task.features(worlds)
        if self._layout is None:
            self._sensors = SensorVector(task.sensors, {obs.vehicle: obs})
            self._layout = Layout(len(self._names), task.message_floats, features.shape[-1], self._sensors.size)
            self._bounds = self._layout.bounds(task, self._sensors.bounds)
        observation = self._layout.observations(worlds, features, self._bounds)[0, row]
        if self._sensors.size:
            observation[self._layout.sensors] = self._sensors.values(obs.readings)
        action = self._network(observation).astype(np.float32)
        if action.shape != (task.action_size,):
            raise ValueError(f"the policy gives {len(action)} numbers; the task {task.name} needs {task.action_size}")
        if action[task.motions] > 0.0:
            radio.send(action[task.motions + 1 :].astype("<f4").tobytes())
        x, y, z, turn = task.motion(action[: task.motions].astype(float)).tolist()
        return Velocity(linear=(x, y, z) if task.flies else (x, 0.0, 0.0), yaw_rate=turn)

    def _worlds(self, obs: Observation) -> Worlds:
        """The state as far as this vehicle knows it: other vehicles are far away."""
        n, row, state = len(self._names), self._row, obs.state
        position, velocity = np.full((1, n, 3), FAR_M), np.zeros((1, n, 3))
        yaw, yaw_rate = np.zeros((1, n)), np.zeros((1, n))
        position[0, row], velocity[0, row] = state.position, state.velocity
        yaw[0, row] = yaws_of(np.array(state.attitude))
        yaw_rate[0, row] = state.angular_velocity[2]
        return Worlds(
            time_s=np.array([obs.time_ns / 1e9]),
            position=position,
            velocity=velocity,
            yaw=yaw,
            yaw_rate=yaw_rate,
            memory=self._memory,
            **self._mail.ages(obs.clock_ns),
        )


__all__ = ["META", "Network", "Policy", "PolicyMeta", "load_network", "meta_of", "save_network"]
