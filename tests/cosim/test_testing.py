"""Conformance kits accept correct agents, layers and federates, and refuse faulty ones."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, Federate, Instants, RunInfo, Slot, Step
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.testing import check_agent, check_channel, check_federate
from vcmvsp.cosim.types import Message, Note, States, Velocity, frozen
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.impairments.delay import FixedDelay, NoDelay
from vcmvsp.netsim.impairments.loss import Bernoulli, NoLoss
from vcmvsp.netsim.phy.constant_rate import ConstantRate
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import Ieee802154
from vcmvsp.netsim.propagation.path_loss import LogDistance, NoPathLoss
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World

RUN = RunInfo(scenario="check", seed=1, duration_ns=10**9, vehicles=("car1", "car2"), instants=(Instants(Ticks.every(0.1)),))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Trajectory("circle"),
        lambda: Trajectory("random"),
        lambda: LeaderFollower("car1", bearing_deg=30.0),
        lambda: LeaderFollower("car1", handle=0.3, estimator="hold", broadcast=True),
    ],
)
def test_the_agents_of_the_platform_conform(make: Callable[[], Agent]) -> None:
    check_agent(make)


class RandomAgent(Agent):
    """Draws from an unseeded generator."""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        return Velocity(linear=(float(np.random.default_rng().random()), 0.0, 0.0))


class UncheckedAgent(Agent):
    """Accepts messages without checking them."""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        bodies: list[Any] = [each.message.body for each in obs.heard]
        return Velocity(linear=(sum(body["x"] for body in bodies), 0.0, 0.0))


class TextAgent(Agent):
    """Returns a value that is not a command."""

    def act(self, obs: Observation, radio: Radio) -> Any:
        return "forward"


@pytest.mark.parametrize(
    ("make", "law"), [(RandomAgent, "acted differently"), (UncheckedAgent, "raised"), (TextAgent, "must return a Velocity")]
)
def test_an_agent_that_breaks_a_law_is_refused(make: Callable[[], Agent], law: str) -> None:
    with pytest.raises(AssertionError, match=law):
        check_agent(make)


def test_an_agent_in_place_of_a_function_is_refused_with_the_right_call() -> None:
    with pytest.raises(TypeError, match=r"check_agent\(lambda: TextAgent\(\.\.\.\)\)"):
        check_agent(TextAgent())  # type: ignore[arg-type]


LAYERS = (
    *(LogDistance(), NoPathLoss(), ConstantRate(), Dsss(), Ieee802154()),
    *(NoLoss(), Bernoulli(0.3), NoDelay(), FixedDelay(0.1, 0.02)),
)


@pytest.mark.parametrize("layer", LAYERS)
def test_the_layers_of_the_platform_conform(layer: object) -> None:
    check_channel(layer)


class OneWayLoss:
    """Path loss differs between the two directions."""

    def loss_db(self, paths: Any) -> Any:
        return paths.distance_m + paths.rx[:, 2]


class CrowdLoss:
    """Path loss depends on the number of receivers."""

    def loss_db(self, paths: Any) -> Any:
        return paths.distance_m + len(paths.distance_m)


class InfiniteLoss:
    """Infinite at distance 0."""

    def loss_db(self, paths: Any) -> Any:
        with np.errstate(divide="ignore"):
            return 20.0 * np.log10(paths.distance_m)


class NoCauseLoss:
    """Losses without a cause."""

    cause = ""

    def lost(self, frame: Any, draw: Any) -> Any:
        return draw()[:, 0] < 0.5


@pytest.mark.parametrize(
    ("layer", "law"),
    [
        (OneWayLoss(), "back"),
        (CrowdLoss(), "who else listens"),
        (InfiniteLoss(), "not finite"),
        (NoCauseLoss(), "cause"),
        (object(), "none of"),
    ],
)
def test_a_layer_that_breaks_a_law_is_refused(layer: object, law: str) -> None:
    with pytest.raises(AssertionError, match=law):
        check_channel(layer)
    if isinstance(layer, OneWayLoss):
        check_channel(layer, reciprocal=False)


COMMANDS = [Event("car1/command", 150_000_000, Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.1))]


@pytest.mark.parametrize("kind", [KinematicPhysics, BulletPhysics])
def test_the_physics_conforms(kind: Any) -> None:
    cars = [
        VehicleSpec(name=name, model=P2DX(), position=(x, 0.0, 0.0), positioning=Positioning(rate_hz=5.0))
        for name, x in (("car1", 0.0), ("car2", 2.0))
    ]
    check_federate(lambda: kind(world=World(), vehicles=cars), RUN, COMMANDS)


def test_the_radio_conforms() -> None:
    rest = np.zeros((2, 3))
    states = States(
        names=("car1", "car2"),
        position=frozen([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]),
        velocity=frozen(rest),
        attitude=frozen(np.eye(2, 4)),
        angular_velocity=frozen(rest),
    )
    sends = [Event("car1/send", k * 10**8, Message(sender="car1", body={"x": 1.0}, size_bytes=20)) for k in range(10)]
    channel = Channel(path_loss=LogDistance(), phy=Dsss(), loss=Bernoulli(0.5), delay=FixedDelay(0.1, 0.05))
    check_federate(lambda: RadioFederate(channel), RUN, [Event("world/states", 0, states), *sends])


class EventEachStep:
    """Sends an event each step; subclasses break a law."""

    name, slot, wake_slot = "stuck", Slot.WORLD, Slot.APPLY
    reads: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    delay_ns, back_ns, value = 10**8, 0, 1.0

    def start(self, run: RunInfo) -> int | None:
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        return Step([Event("stuck/note", now_ns - self.back_ns, Note(values={"x": self.value}))], now_ns + self.delay_ns)

    def close(self) -> None:
        pass


class Looping(EventEachStep):
    delay_ns = 0


class Backdating(EventEachStep):
    back_ns = 1


class Unseeded(EventEachStep):
    count = 0

    def start(self, run: RunInfo) -> int | None:
        Unseeded.count += 1
        self.value = float(stream(Unseeded.count, "unseeded").random())
        return 0


@pytest.mark.parametrize(
    ("make", "law"), [(Looping, "requested the next step"), (Backdating, "was returned at"), (Unseeded, "different events")]
)
def test_a_federate_that_breaks_a_law_is_refused(make: Callable[[], Federate], law: str) -> None:
    check_federate(EventEachStep, RUN)
    with pytest.raises(AssertionError, match=law):
        check_federate(make, RUN)
