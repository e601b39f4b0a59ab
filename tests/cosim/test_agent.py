"""Agent API: sizes of messages, plain content, notes, and an agent's own random streams."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Message, Mosaic, ProbabilityMap, Sighting, Sightings, VehicleState, Velocity
from vcmvsp.cosim.util.codec import Decoder, encode

VEHICLES = ("car1", "car2", "car3")
PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def sent(*args: Any, **values: Any) -> Message:
    """The one message of one call of ``send``."""
    radio = Radio("car1", VEHICLES)
    radio.send(*args, **values)
    (message,) = radio.drain()
    return message


@given(st.dictionaries(st.text(max_size=5), PLAIN, max_size=4) | st.binary(max_size=300))
def test_a_mapping_counts_as_many_bytes_as_its_messagepack_and_bytes_as_they_are(body: dict[str, Any] | bytes) -> None:
    message = sent(body)
    data = body if isinstance(body, bytes) else msgspec.msgpack.encode(body)
    assert (message.body, message.size_bytes) == (body, len(data))
    assert (message.sender, message.to) == ("car1", None)


def test_keywords_are_added_to_the_mapping() -> None:
    assert sent({"x": 1.0}, y=2.0).body == {"x": 1.0, "y": 2.0}
    assert sent({"x": 1.0}, x=2.0).body == {"x": 2.0}
    assert sent().body == {}
    assert sent(body=1).body == {"body": 1}  # the first parameter is positional-only: "body" is a keyword like any other


def test_a_float_takes_nine_bytes_and_a_small_number_one() -> None:
    # MessagePack: fixmap 1, fixstr 1 + n, float 64 9, positive fixint 1
    assert sent(x=1.0).size_bytes == 1 + 2 + 9
    assert sent(x=1).size_bytes == 1 + 2 + 1


def test_the_size_can_be_set() -> None:
    assert sent(b"abc", size_bytes=1500).size_bytes == 1500
    assert sent(x=1, size_bytes=0).size_bytes == 0
    assert sent(x=1, size_bytes=np.int64(7)).size_bytes == 7
    with pytest.raises(ValueError, match="size_bytes=-1"):
        sent(x=1, size_bytes=-1)


def test_numpy_content_arrives_as_plain_numbers_and_lists() -> None:
    body = sent(a=np.float64(0.1), b=np.float32(0.5), c=np.int16(3), d=np.bool_(True), e=np.arange(4).reshape(2, 2)).body
    assert body == {"a": 0.1, "b": 0.5, "c": 3, "d": True, "e": [[0, 1], [2, 3]]}
    assert isinstance(body, dict)
    assert [type(each) for each in body.values()] == [float, float, int, bool, list]
    assert sent(x=np.float64(0.1)).size_bytes == sent(x=0.1).size_bytes


def test_a_sent_body_is_a_copy_with_lists_for_tuples_as_over_a_wire() -> None:
    path = [1.0]
    message = sent(path=path, at=(1.0, 2.0))
    path.append(2.0)
    assert message.body == {"path": [1.0], "at": [1.0, 2.0]}


@pytest.mark.parametrize("to", ["car9", "car1", "", "*"])
def test_only_another_vehicle_of_the_run_can_be_addressed(to: str) -> None:
    with pytest.raises(ValueError, match="unknown receiver; other vehicles: ") as caught:
        sent(x=1, to=to)
    assert all(name in str(caught.value) for name in (repr(to), "car2", "car3"))
    assert sent(x=1, to="car2").to == "car2"


@pytest.mark.parametrize("bad", [object(), 1j, {1, 2}.__iter__(), np.array([object()]), VehicleState])
def test_bodies_that_cannot_be_encoded_are_refused(bad: Any) -> None:
    with pytest.raises(TypeError, match=r"radio\.send\(\)"):
        sent(x=bad)


def test_bytes_and_named_values_do_not_mix() -> None:
    with pytest.raises(TypeError, match="not both"):
        sent(b"abc", x=1)


def test_a_refused_message_is_not_sent_later() -> None:
    radio = Radio("car1", VEHICLES)
    with pytest.raises(ValueError, match="car9"):
        radio.send(x=1, to="car9")
    radio.send(x=2)
    radio.send(x=3)
    assert [message.body for message in radio.drain()] == [{"x": 2}, {"x": 3}]
    assert radio.drain() == []


def test_notes_are_plain_and_taken_once() -> None:
    one, other = Agent(), Agent()
    one.note(age_s=np.float64(0.1), count=3)
    one.note(status="waiting", lost=True, count=4)
    assert one.drain_notes() == {"age_s": 0.1, "count": 4.0, "status": "waiting", "lost": True}
    assert one.drain_notes() == {}
    assert other.drain_notes() == {}


def a_map(**changes: Any) -> ProbabilityMap:
    cells = {"probability": np.full((2, 3), 127, np.uint8), "seen": np.zeros((2, 3), np.bool_)}
    return ProbabilityMap(**{"left": 1.0, "bottom": 2.0, "cell_m": 0.5, **cells, **changes})


def a_mosaic(**changes: Any) -> Mosaic:
    return Mosaic(**{"left": 1.0, "bottom": 2.0, "cell_m": 0.5, "pixels": np.zeros((2, 3, 3), np.uint8), **changes})


def a_sighting(**changes: Any) -> Sighting:
    values = {"target": "a", "place": (0.0, 1.0), "centre_px": (4.0, 2.0), "angle": 0.1, "side_px": 9.0, "score": 0.9}
    return Sighting(**{**values, **changes})


def sightings(*found: Any, **changes: Any) -> Sightings:
    return Sightings(**{"sensor": "camera", "time_ns": 5, "width": 8, "height": 6, "found": found, "jpeg": b"x", **changes})


def test_shown_arrays_are_copies() -> None:
    """An agent may change its arrays later; the recording has them as they were shown."""
    agent, probability, seen = Agent(), np.zeros((2, 2), np.uint8), np.zeros((2, 2), bool)
    pixels = np.zeros((2, 2, 3), np.uint8)
    agent.show(a_map(probability=probability, seen=seen))
    agent.show(a_mosaic(pixels=pixels))
    for each in (probability, seen, pixels):
        each[:] = 1
    shown: dict[str, Any] = dict(agent.drain_shown())
    for each in (shown["map"].probability, shown["map"].seen, shown["mosaic"].pixels):
        assert (each.any(), each.flags.writeable) == (False, False)
    assert agent.drain_shown() == {}


@pytest.mark.parametrize(
    "value",
    [
        a_map(
            left=np.float32(1.5), bottom=np.int64(2), probability=np.asfortranarray(np.arange(6, dtype=np.uint8).reshape(2, 3))
        ),
        a_mosaic(cell_m=1, pixels=np.arange(36, dtype=np.uint8).reshape(2, 6, 3)[:, ::2]),
        sightings(a_sighting(place=(np.float32(0.1), np.float64(0.2)), score=np.float32(0.3)), width=np.int64(8)),
    ],
)
def test_shown_values_equal_their_decoded_encoding(value: Any) -> None:
    agent = Agent()
    agent.show(value)
    (plain,) = agent.drain_shown().values()
    kind = type(value)
    assert encode(plain) == encode(Decoder(kind).decode(encode(value)))
    numbers = plain.found[0].place if isinstance(plain, Sightings) else (plain.left, plain.bottom, plain.cell_m)
    assert {type(each) for each in numbers} == {float}


UNFIT: list[tuple[Any, str]] = [
    (sightings(a_sighting(score=math.nan)), "numbers that are not finite"),
    (sightings(a_sighting(target=5)), "Expected `str`, got `int`"),
    (sightings(a_sighting(target="\ud800")), "surrogates not allowed"),
    (sightings(time_ns=None), "Expected `int`, got `None`"),
    (sightings(width=0), "a picture of 0 x 6 pixels"),
    (a_map(seen=np.zeros((2, 2), np.bool_)), "cells that must be (rows, columns) of uint8 and of bool"),
    (a_map(probability=np.zeros((2, 3))), "cells that must be (rows, columns) of uint8 and of bool"),
    (a_map(probability=np.zeros((0, 3), np.uint8), seen=np.zeros((0, 3), np.bool_)), "no cells"),
    (a_map(left=math.inf), "cells of 0.5 m from (inf, 2) m"),
    (a_map(cell_m=1e300), "cells of 1e+300 m from (1, 2) m"),
    (a_map(left="west"), "could not convert string to float"),
    (a_mosaic(pixels=np.zeros((2, 3), np.uint8)), "pixels (2, 3) of uint8"),
    (a_mosaic(pixels=np.zeros((0, 3, 3), np.uint8)), "no cells"),
    (a_mosaic(cell_m=0.0), "cells of 0 m from (1, 2) m"),
]


@pytest.mark.parametrize(("value", "words"), UNFIT)
def test_values_that_cannot_be_recorded_are_not_shown(value: Any, words: str) -> None:
    agent = Agent()
    with pytest.raises(ValueError, match=rf"show\({type(value).__name__}\)") as caught:
        agent.show(value)
    assert words in str(caught.value)
    assert agent.drain_shown() == {}


def test_only_types_with_a_topic_are_shown() -> None:
    with pytest.raises(TypeError, match=r"show\(Velocity\): only a ProbabilityMap, Sightings or a Mosaic"):
        Agent().show(Velocity())  # type: ignore[arg-type]


def test_an_agent_need_not_call_the_base_constructor() -> None:
    class Own(Agent):
        def __init__(self) -> None:
            self.mine = 1

        def act(self, obs: Observation, radio: Radio) -> Velocity | None:
            self.note(mine=self.mine)
            return None

    own = Own()
    observation = Observation(vehicle="car1", time_ns=1_500_000_000, state=VehicleState(position=(0.0, 0.0, 0.0)), readings={})
    assert observation.time_s == 1.5
    assert own.act(observation, Radio("car1", VEHICLES)) is None
    assert own.drain_notes() == {"mine": 1.0}
    with pytest.raises(NotImplementedError):
        Agent().act(observation, Radio("car1", VEHICLES))


def test_each_agent_has_its_own_streams() -> None:
    def info(name: str, seed: int) -> VehicleInfo:
        return VehicleInfo(name=name, vehicles=VEHICLES, period_s=0.1, latency_s=0.0, seed=seed)

    def head(generator: np.random.Generator) -> list[float]:
        return generator.random(4).tolist()

    here = head(info("car1", 1).stream("explore"))
    assert head(info("car1", 1).stream("explore")) == here
    assert head(stream(1, "car1/agent/explore")) == here
    others = [info("car1", 1).stream("other"), info("car2", 1).stream("explore"), info("car1", 2).stream("explore")]
    assert all(head(other) != here for other in others)
