"""Conformance checks for what others write: agents, channel layers, federates. One line in a test of theirs proves the laws.

Nothing of the platform imports it.

::

    from vcmvsp.cosim.testing import check_agent, check_channel
    check_agent(lambda: KeepGap(leader="car1"))
    check_channel(Rain())

Every check raises `AssertionError` that says which law is broken.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from vcmvsp.cosim.agent import Agent, AgentSpec, Observation
from vcmvsp.cosim.errors import AgentError
from vcmvsp.cosim.federate import Event, Federate, RunInfo, Step, matches
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.received import ReceivedMessages, receptions_at
from vcmvsp.cosim.types import RECEPTIONS, Array, Message, Reception, VehicleState
from vcmvsp.cosim.util.codec import Decoder, encode

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.parts.radio import Frame, PathLoss, Phy

SECOND = 1_000_000_000
_receptions: Decoder[list[Reception]] = Decoder(list[Reception])
_events: Decoder[list[Event]] = Decoder(list[Event])


def check_agent(
    make: Callable[[], Agent], *, vehicle: str = "car2", others: Sequence[str] = ("car1", "car3"), ticks: int = 40
) -> None:
    """Check that agents made by ``make`` keep the contract of `vcmvsp.Agent`.

    The laws: an agent acts before it has received a message; it survives unknown messages (other keys, other types, NaN,
    bytes); its commands and messages are finite and can be encoded; two agents with equal observations give equal outputs; it
    does not modify its observations; the wire encoding of observations makes no difference.

    Args:
        make: makes a new agent, e.g. ``lambda: KeepGap("car1")``; the laws need several.
    """
    if not callable(make):
        raise TypeError(f"needs a function that makes an agent, as in check_agent(lambda: {type(make).__name__}(...))")
    observations = [_observation(vehicle, others, tick) for tick in range(ticks)]
    plain = _play(make(), vehicle, others, observations)
    _require(plain == _play(make(), vehicle, others, observations), "two agents with equal inputs acted differently")
    fresh = [_observation(vehicle, others, tick) for tick in range(ticks)]
    wire = [encode(list(each.heard)) for each in observations]
    _require(wire == [encode(list(each.heard)) for each in fresh], "the agent modified its observation")
    received = [
        ReceivedMessages.of(_receptions.decode(each), observation.time_ns)
        for each, observation in zip(wire, observations, strict=True)
    ]
    wired = [msgspec.structs.replace(observation, heard=each) for each, observation in zip(received, observations, strict=True)]
    _require(plain == _play(make(), vehicle, others, wired), "the agent acts differently in another process")


def check_channel(layer: Any, *, reciprocal: bool = True) -> None:
    """Check that a layer of the radio keeps the contract of `netsim.interfaces.layers`, for all methods that it has.

    The laws: one finite result per receiver, of the right type; equal calls give equal results; a receiver's result does not
    depend on the other receivers; path loss is equal in both directions (unless ``reciprocal`` is false).
    """
    verbs: dict[str, Callable[[Any, str], None]] = {
        "loss_db": _check_path_loss,
        "air_time_ns": _check_phy,
        "gain_db": _check_drawn,
        "lost": _check_drawn,
        "delay_ns": _check_drawn,
    }
    methods = [verb for verb in verbs if callable(getattr(layer, verb, None))]
    _require(bool(methods), f"{type(layer).__name__} has none of the methods of a layer: {', '.join(verbs)}")
    for verb in methods:
        verbs[verb](layer, verb)
    if "loss_db" in methods and reciprocal:
        _check_reciprocity(layer)


def check_federate(make: Callable[[], Federate], run: RunInfo, inputs: Sequence[Event] = ()) -> None:
    """Check that federates made by ``make`` keep the contract of `cosim.federate.Federate` in a run of their own.

    The laws: names and slots are declared; every event takes effect no earlier than its step, has a valid key and can be
    encoded; the next wake-up is in the future; two federates with equal inputs give equal outputs; closing works.

    Args:
        make: makes a new federate.
        run: its run information.
        inputs: events, delivered at their time if the federate subscribes to them.
    """
    first, second = _step_through(make(), run, inputs), _step_through(make(), run, inputs)
    _require(first == second, "two federates with equal inputs returned different events")


def _play(agent: Agent, vehicle: str, others: Sequence[str], observations: Sequence[Observation]) -> bytes:
    """All outputs of the agent, encoded."""
    from vcmvsp.cosim.assembly.parts.agent_host import AgentHost

    spec = AgentSpec(
        vehicle=vehicle, kind=type(agent).__name__, folder="", params={}, defaults={}, period_s=None, latency_s=0.0, source=""
    )
    federate, vehicles = AgentHost("agents", [spec], {vehicle: agent}), (*others, vehicle)
    messages = []
    try:
        federate.start(RunInfo(scenario="check", seed=1, duration_ns=len(observations) * SECOND, vehicles=vehicles))
        now = 0
        for observation in observations:
            inbox = [Event(f"{vehicle}/estimate", observation.time_ns, observation.state)]
            inbox.append(Event(RECEPTIONS, observation.time_ns, receptions_at(vehicle, observation.heard, vehicles)))
            step = federate.step(now, inbox)
            messages.append(list(step.events))
            assert step.next_ns is not None  # noqa: S101  an agent always has a next tick
            now = step.next_ns
    except AgentError as error:
        raise AssertionError(f"{error}\n{error.details}") from error
    finally:
        federate.close()
    return encode(messages)


def _observation(vehicle: str, others: Sequence[str], tick: int) -> Observation:
    """A test observation: no messages at first, then valid and invalid ones in turn."""
    rng = np.random.default_rng(tick)
    x, y, yaw = rng.uniform(-3.0, 3.0, 3).tolist()
    now = tick * SECOND // 10
    return Observation(
        vehicle=vehicle,
        time_ns=now,
        state=VehicleState(position=(x, y, 0.0), attitude=quaternion_from_yaw(yaw)),
        readings={},
        heard=ReceivedMessages.of([_nonsense(other, now, tick) for other in others if tick >= 5], now),
    )


def _nonsense(sender: str, now: int, tick: int) -> Reception:
    nan = float("nan")
    bodies: list[dict[str, Any] | bytes] = [
        {"seq": tick, "t_ns": now - SECOND // 10, "x": 0.1 * tick, "y": 0.0, "th": 0.0, "v": 0.3, "w": 0.0},
        {"seq": tick, "t_ns": now - SECOND // 10, "x": nan, "y": 0.0, "th": 0.0, "v": nan, "w": 0.0},
        {"seq": "one", "t_ns": None, "x": "far", "y": [1, 2], "th": {}, "v": True, "w": -1},
        {},
        b"\x00\xff not a mapping",
        {"unknown": 1},
    ]
    message = Message(sender=sender, body=bodies[tick % len(bodies)], size_bytes=20)
    return Reception(message=message, rssi_dbm=-60.0, sent_ns=max(0, now - SECOND // 10), received_ns=now)


def _check_path_loss(layer: "PathLoss", verb: str) -> None:
    from vcmvsp.cosim.assembly.parts.radio import Paths

    rng = np.random.default_rng(1)
    tx, rx = rng.uniform(-300.0, 300.0, 3), rng.uniform(-300.0, 300.0, (20, 3))
    rx[0] = tx  # two antennas in one place
    loss = layer.loss_db(Paths.between(tx, rx))
    _require(np.shape(loss) == (20,), f"{verb} gave shape {np.shape(loss)} for 20 receivers")
    _require(bool(np.isfinite(loss).all()), f"{verb} is not finite: {loss}")
    _require(np.array_equal(loss, layer.loss_db(Paths.between(tx, rx))), f"{verb} answers the same question differently")
    alone = np.concatenate([layer.loss_db(Paths.between(tx, each[None])) for each in rx])
    _require(np.array_equal(loss, alone), f"{verb} of a receiver depends on who else listens")


def _check_reciprocity(layer: "PathLoss") -> None:
    from vcmvsp.cosim.assembly.parts.radio import Paths

    rng = np.random.default_rng(3)
    for a, b in rng.uniform(-300.0, 300.0, (50, 2, 3)):
        forth_db, back_db = layer.loss_db(Paths.between(a, b[None])), layer.loss_db(Paths.between(b, a[None]))
        law = f"loss from {a} to {b} is {forth_db}, back {back_db}; pass reciprocal=False if this is intended"
        _require(forth_db.tolist() == back_db.tolist(), law)


def _check_phy(layer: "Phy", verb: str) -> None:
    times = [layer.air_time_ns(size) for size in range(0, 1500, 7)]
    _require(all(type(each) is int and each >= 1 for each in times), f"{verb} must be a whole number of ns, at least 1")
    _require(times == sorted(times), f"{verb} is shorter for a longer payload")
    levels = (layer.tx_power_dbm, layer.sensitivity_dbm)
    _require(bool(np.isfinite(levels).all()), f"tx_power_dbm and sensitivity_dbm must be finite, not {levels}")


def _check_drawn(layer: Any, verb: str) -> None:
    rng = np.random.default_rng(2)
    draws = rng.random((20, 2))
    names = tuple(f"car{i}" for i in range(20))
    frame, pick = _frame(rng.uniform(-100.0, 100.0, (20, 3)), names), getattr(layer, verb)
    answer = pick(frame, lambda: draws)
    kinds: Mapping[str, Any] = {"lost": np.bool_, "delay_ns": np.integer, "gain_db": np.floating}
    _require(np.shape(answer) == (20,), f"{verb} gave shape {np.shape(answer)} for 20 receivers")
    _require(bool(np.issubdtype(np.asarray(answer).dtype, kinds[verb])), f"{verb} gave {np.asarray(answer).dtype}")
    _require(np.array_equal(answer, pick(frame, lambda: draws)), f"{verb} answers the same question differently")
    order = rng.permutation(20)
    moved = pick(_frame(frame.paths.rx[order], tuple(names[i] for i in order)), lambda: draws[order])
    _require(np.array_equal(np.asarray(answer)[order], moved), f"{verb} of a receiver depends on who else listens")
    if verb == "lost":
        _require(layer.cause not in ("", "received", "under way"), "a loss must name its cause")
    else:
        _require(bool(np.isfinite(answer).all()), f"{verb} is not finite: {answer}")


def _frame(rx: Array, receivers: tuple[str, ...]) -> "Frame":
    from vcmvsp.cosim.assembly.parts.radio import Frame, Paths, SenderLinks

    paths = Paths.between(np.zeros(3), rx)
    links = SenderLinks(1, "sender", receivers)
    return Frame(0, 0, SECOND // 1000, 60, paths, -60.0 - paths.distance_m / 10.0, links)


def _step_through(federate: Federate, run: RunInfo, inputs: Sequence[Event]) -> bytes:
    _require(isinstance(federate, Federate), f"{type(federate).__name__} lacks an attribute or method of Federate")
    subscriptions = (*federate.reads, *federate.latest)
    waiting = sorted((event for event in inputs if _any(subscriptions, event.key)), key=lambda event: event.time_ns)
    events: list[Event] = []
    try:
        due = federate.start(run)
        while True:
            waking = next((event.time_ns for event in waiting if _any(federate.wakes, event.key)), None)
            now = min((each for each in (due, waking) if each is not None), default=run.duration_ns + 1)
            if now > run.duration_ns:
                return encode(events)
            inbox = [event for event in waiting if event.time_ns <= now]
            waiting = waiting[len(inbox) :]
            step = federate.step(now, inbox)
            _check_step(step, now)
            events += step.events
            due = step.next_ns
    finally:
        federate.close()


def _check_step(step: Step, now: int) -> None:
    _require(step.next_ns is None or step.next_ns > now, f"the step at {now} ns requested the next step at {step.next_ns} ns")
    for event in step.events:
        _require(event.time_ns >= now, f"{event.key} with the time {event.time_ns} ns was returned at {now} ns")
        _require(all(event.key.split("/")) and not set(event.key) & set("*$#?"), f"'{event.key}' is no valid key")
        try:
            again = _events.decode(encode([event]))
        except (msgspec.MsgspecError, TypeError) as error:
            raise AssertionError(f"the value of {event.key} cannot be sent: {error}") from error
        _require(encode(again) == encode([event]), f"the value of {event.key} changes when it is encoded and decoded")


def _any(expressions: Sequence[str], key: str) -> bool:
    return any(matches(each, key) for each in expressions)


def _require(holds: bool, law: str) -> None:
    if not holds:
        raise AssertionError(law)
