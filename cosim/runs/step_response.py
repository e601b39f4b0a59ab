"""Step response of one vehicle of a scenario to a constant command."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.assembly.parts.vehicles import flies
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario.schema import AgentsTable
from vcmvsp.cosim.types import Array, States, Velocity, Waypoint

SCHEMA = "vcmvsp.drive/1"
STEP_S = 0.05  # between rows, if the physics step allows it
ARRIVED_M = 0.1
LARGEST = 1e6  # m, m/s, rad, rad/s
NEAR = 0.9  # rise time: until this fraction of the final speed
_VELOCITY = ("v", "vx", "vy", "vz", "w")
_WAYPOINT = ("x", "y", "z", "yaw", "speed")


class Constant(Agent):
    """Agent with a constant command."""

    def __init__(self, command: Velocity | Waypoint, period_s: float) -> None:
        self._command, self.period, self.sensors = command, period_s, ()

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint:
        """The constant command."""
        return self._command


def command_of(text: str, heading: float, *, flies: bool) -> Velocity | Waypoint:
    """Parse ``v=0.3,w=0.5`` (forward, yaw rate), ``vx=1,vy=0,vz=0.2,w=0`` (aerial) or ``x=1,y=2,z=3,yaw=0,speed=1``.

    Args:
        heading: of the vehicle at the start, rad.
        flies: whether velocities are in the world frame; ``v`` is then along the heading.
    """
    values = _numbers(text)
    if not flies and (others := {*values} - {"v", "w"}):
        raise UsageError(f"--command {text}: {', '.join(sorted(others))} are for flying vehicles; use v and w")
    if {*values} <= {*_VELOCITY}:
        if "v" in values and {"vx", "vy"} & {*values}:
            raise UsageError(f"--command {text}: use either v, or vx and vy")
        v = values.get("v", 0.0)
        x, y = (values.get("vx", 0.0), values.get("vy", 0.0)) if "v" not in values else (v, 0.0)
        if flies and "v" in values:
            x, y = v * math.cos(heading), v * math.sin(heading)
        return Velocity(linear=(x, y, values.get("vz", 0.0)), yaw_rate=values.get("w", 0.0))
    if {*values} <= {*_WAYPOINT} and {"x", "y", "z"} <= {*values} and values.get("speed", 1.0) > 0.0:
        place = values["x"], values["y"], values["z"]
        return Waypoint(position=place, yaw=values.get("yaw"), speed=values.get("speed"))
    raise UsageError(
        f"--command {text}: must be a velocity ({', '.join(_VELOCITY)}) or a waypoint (x, y, z, optionally yaw, speed > 0)"
    )


def _numbers(text: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = part.strip().partition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if name not in (*_VELOCITY, *_WAYPOINT) or not abs(value) <= LARGEST:
            allowed = ", ".join((*_VELOCITY, *_WAYPOINT))
            raise UsageError(f"--command {text}: '{part.strip()}' must be NAME=NUMBER with {allowed}")
        if name in values:
            raise UsageError(f"--command {text}: {name} is given twice")
        values[name] = value
    return values


def drive(
    what: str | Path | Mapping[str, Any], vehicle: str, command: str, seconds: float, settings: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Simulate the response of one vehicle to one command; all others stand still.

    Args:
        command: see `command_of`.
        settings: changed keys of the scenario.

    Returns:
        The response (schema ``vcmvsp.drive/1``): columns over time and characteristic values, SI units.
    """
    parsed, source = scenarios.load(what, settings={**(settings or {}), "duration_s": seconds})
    if parsed.real:
        parsed, source = scenarios.load(what, settings={**(settings or {}), **parsed.twins, "duration_s": seconds})
    names = [each.name for each in parsed.vehicle]
    if vehicle not in names:
        raise UsageError(f"--vehicle {binding.unknown('vehicle', vehicle, names)}")
    table = parsed.vehicle[names.index(vehicle)]
    kind = registry.find("vehicle", table.kind, folder=source.folder, key=f"vehicle.{vehicle}.kind", origin=source)
    flying = flies(kind)
    order = command_of(command, table.start[1], flies=flying)
    steps = STEP_S * parsed.physics.get("rate_hz", 120.0)
    period_s = STEP_S if abs(steps - round(steps)) < 1e-9 else min(parsed.record.period_s, 0.1)
    alone = msgspec.structs.replace(
        parsed,
        agents=AgentsTable(),
        record=msgspec.structs.replace(parsed.record, period_s=period_s),
        vehicle=tuple(msgspec.structs.replace(each, agent=None) for each in parsed.vehicle),
    )
    response = _Response(vehicle, flies=flying)
    with assemble(alone, source, objects={vehicle: Constant(order, period_s)}) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        assembled.start(kernel)
        try:
            kernel.run(response.on)
        finally:
            kernel.close()
    return {
        "schema": SCHEMA,
        "scenario": parsed.name,
        "vehicle": vehicle,
        "kind": table.kind,
        "command": command,
        **response.figures(order),
    }


class _Response:
    """Collects the published events of one vehicle."""

    def __init__(self, vehicle: str, *, flies: bool) -> None:
        self._vehicle, self._flies, self._rows, self._contacts = vehicle, flies, dict[int, list[float]](), 0

    def on(self, event: Event) -> None:
        """Observe an event."""
        if isinstance(event.value, States):
            row, states = event.value.names.index(self._vehicle), event.value
            _, qx, qy, _ = attitude = states.attitude[row].tolist()
            tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (qx * qx + qy * qy))))
            self._rows[event.time_ns] = [
                *states.position[row].tolist(),
                yaw_of(attitude),
                *states.velocity[row].tolist(),
                float(states.angular_velocity[row, 2]),
                tilt,
            ]
        elif event.key == "world/contact" and self._vehicle in (event.value.vehicle, event.value.other):  # type: ignore[union-attr]
            self._contacts += 1

    def figures(self, command: Velocity | Waypoint) -> dict[str, Any]:
        """Columns over time and characteristic values."""
        time_s = np.array(sorted(self._rows)) / SECOND_NS
        rows = np.array([self._rows[each] for each in sorted(self._rows)])
        x, y, z, yaw, vx, vy, vz, w, tilt = rows.T
        yaw = np.unwrap(yaw)
        v = vx * np.cos(yaw) + vy * np.sin(yaw)
        columns = {
            "time_s": time_s,
            "x": x,
            "y": y,
            "z": z,
            "yaw": yaw,
            "v": v,
            "vx": vx,
            "vy": vy,
            "vz": vz,
            "w": w,
            "tilt": tilt,
        }
        path = np.hypot(np.hypot(np.diff(x), np.diff(y)), np.diff(z)).sum()
        figures: dict[str, Any] = {
            "distance_m": float(path),
            "greatest_tilt_rad": float(tilt.max()),
            "contacts": self._contacts,
        }
        if isinstance(command, Velocity):
            (lx, ly, lz), rate = command.linear, command.yaw_rate
            along, target = v, lx
            if self._flies:  # velocities in the world frame: component along the commanded one
                target = math.hypot(lx, ly)
                along = (vx * lx + vy * ly) / target if target else np.hypot(vx, vy)
            figures["v"] = _response(time_s, along, target)
            figures["w"] = _response(time_s, w, rate)
            if self._flies:
                figures["vz"] = _response(time_s, vz, lz)
        else:
            away = np.sqrt(sum((now - to) ** 2 for now, to in zip((x, y, z), command.position, strict=True)))
            figures["final_error_m"] = float(away[-1])
            inside = np.nonzero(away > ARRIVED_M)[0]
            first = inside[-1] + 1 if len(inside) else 0  # inside the tolerance from here on
            figures["arrival_s"] = float(time_s[first]) if first < len(time_s) else None
        return {**figures, "series": {name: column.tolist() for name, column in columns.items()}}


def _response(time_s: Array, series: Array, target: float) -> dict[str, Any]:
    """Steady value (mean of the last quarter), error, rise time to 90 % of the command, overshoot."""
    steady = float(series[3 * len(series) // 4 :].mean())
    about: dict[str, Any] = {"commanded": target, "steady": steady}
    if target:
        reached = np.nonzero(series / target >= NEAR)[0]
        about["error_percent"] = 100.0 * (steady / target - 1.0)
        about["rise_time_s"] = float(time_s[reached[0]]) if len(reached) else None
        about["overshoot_percent"] = max(0.0, 100.0 * (float((series / target).max()) - 1.0))
    return about


def summary(about: dict[str, Any]) -> str:
    """Characteristic values as lines of text."""
    lines = [f"{about['vehicle']} ({about['kind']}), {about['command']}, {about['series']['time_s'][-1]:g} s:"]
    for name, value in about.items():
        if isinstance(value, dict) and name != "series":
            parts = [f"{key.replace('_', ' ')} {number:.4g}" for key, number in value.items() if number is not None]
            lines.append(f"  {name}: {', '.join(parts)}")
        elif isinstance(value, int | float):
            lines.append(f"  {name}: {value:.4g}")
    return "\n".join(lines) + "\n"
