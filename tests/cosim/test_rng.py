"""Random streams: published test vectors of the generator, uniformity, independence from all other draws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim import rng
from vcmvsp.cosim.compiled.machine_code import LOAD_S, Core
from vcmvsp.cosim.rng import key64, link_uniform, philox4x32, stream

# Known-answer vectors of the reference implementation (Random123, tests/kat_vectors, "philox4x32 10").
KNOWN_ANSWERS = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]
U64 = st.integers(0, 2**64 - 1)


def words(text: str) -> tuple[int, ...]:
    return tuple(int(word, 16) for word in text.split())


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_published_vectors(counter: str, key: str, answer: str) -> None:
    c0, c1, c2, c3 = words(counter)
    k0, k1 = words(key)
    assert tuple(int(word) for word in philox4x32((c0, c1, c2, c3), (k0, k1))) == words(answer)


def test_philox_over_arrays_is_philox_of_each_element() -> None:
    counters = np.array([words(counter) for counter, _, _ in KNOWN_ANSWERS], np.uint64)
    keys = np.array([words(key) for _, key, _ in KNOWN_ANSWERS], np.uint64)
    answers = philox4x32((counters[:, 0], counters[:, 1], counters[:, 2], counters[:, 3]), (keys[:, 0], keys[:, 1]))
    assert np.stack(answers, axis=-1).tolist() == [list(words(answer)) for _, _, answer in KNOWN_ANSWERS]


def test_uniforms_take_53_bits_of_two_words_each() -> None:
    a, b, c, d = words(KNOWN_ANSWERS[0][2])
    first, second = link_uniform(np.uint64(0), np.uint64(0), 0).tolist()  # type: ignore[arg-type]  # scalars broadcast too
    assert first == (((a << 32) | b) >> 11) / 2**53
    assert second == (((c << 32) | d) >> 11) / 2**53


@given(st.lists(st.tuples(U64, U64), min_size=1, max_size=20), st.integers(0, 2**32 - 1))
def test_a_draw_depends_on_its_own_link_and_frame_alone(pairs: list[tuple[int, int]], slot: int) -> None:
    keys, frames = (np.array(column, np.uint64) for column in zip(*pairs, strict=True))
    together = link_uniform(keys, frames, slot)
    assert together.shape == (len(pairs), 2)
    assert ((together >= 0.0) & (together < 1.0)).all()
    alone = [link_uniform(keys[i : i + 1], frames[i : i + 1], slot)[0].tolist() for i in range(len(pairs))]
    assert together.tolist() == alone
    backwards = link_uniform(keys[::-1], frames[::-1], slot)[::-1]
    assert together.tolist() == backwards.tolist()


@given(U64, U64, st.integers(0, 2**32 - 1), st.integers(0, 63))
def test_every_bit_of_link_frame_and_slot_counts(key: int, frame: int, slot: int, bit: int) -> None:
    def draw(key: int, frame: int, slot: int) -> list[float]:
        return link_uniform(np.array([key], np.uint64), np.array([frame], np.uint64), slot)[0].tolist()

    here = draw(key, frame, slot)
    assert draw(key ^ (1 << bit), frame, slot) != here
    assert draw(key, frame ^ (1 << bit), slot) != here
    assert draw(key, frame, slot ^ (1 << (bit % 32))) != here


def test_draws_broadcast_over_links_and_frames() -> None:
    assert link_uniform(np.arange(3, dtype=np.uint64)[:, None], np.arange(5, dtype=np.uint64), 1).shape == (3, 5, 2)


@pytest.mark.parametrize("slot", [0, 2**32 - 1])
def test_compiled_draws_are_those_of_numpy(slot: int, monkeypatch: pytest.MonkeyPatch) -> None:
    edges = np.array([0, 1, 2**31, 2**32 - 1, 2**32, 2**63, 2**64 - 1], np.uint64)
    keys = np.concatenate([edges, np.random.default_rng(3).integers(0, 2**64, 200, np.uint64)])
    frames = np.concatenate([edges, np.arange(3, dtype=np.uint64)])[:, None]
    by_numpy = link_uniform(keys, frames, slot)
    monkeypatch.setenv("VCMVSP_COMPILED", "1")
    monkeypatch.setattr(Core, "is_cached", True)
    monkeypatch.setattr(rng, "PAIR_S", LOAD_S)  # compiled at once
    assert link_uniform(keys, frames, slot).tolist() == by_numpy.tolist()
    assert rng._core().is_loaded


# One million fixed draws each: each test's result is always the same. One good generator in two million exceeds a bound of 5
# standard deviations of the statistic.
DRAWS = 10**6


def draws(name: str, slot: int = 0) -> np.ndarray:
    return link_uniform(np.uint64(key64(1, name)), np.arange(DRAWS, dtype=np.uint64), slot)  # type: ignore[arg-type]


def test_draws_are_uniform() -> None:
    for column in draws("radio/car1/car2").T:
        counts = np.histogram(column, bins=1000, range=(0.0, 1.0))[0]
        chi2 = float(((counts - DRAWS / 1000) ** 2).sum() / (DRAWS / 1000))
        assert abs(chi2 - 999) < 5 * np.sqrt(2 * 999)  # mean and standard deviation of chi square with 999 degrees of freedom
        assert abs(column.mean() - 0.5) < 5 / np.sqrt(12 * DRAWS)


def test_frames_links_slots_and_the_two_draws_are_uncorrelated() -> None:
    one = draws("radio/car1/car2")
    others = [draws("radio/car2/car1"), draws("radio/car1/car3"), draws("radio/car1/car2", slot=1)]
    pairs = [(one[:, 0], one[:, 1]), (one[:-1, 0], one[1:, 0])] + [(one[:, 0], other[:, 0]) for other in others]
    for a, b in pairs:
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(DRAWS)


def test_a_key_is_the_same_on_every_machine() -> None:
    # printf 1/car2/positioning | b2sum -l 64
    assert key64(1, "car2/positioning").to_bytes(8, "little").hex() == "32bae8a8e9a19034"
    assert key64(1, "1/car") != key64(11, "/car")  # seed and name are separated
    assert key64(1, "2") != key64(12, "")


def test_a_stream_is_fixed_by_seed_and_name() -> None:
    def head(seed: int, name: str) -> list[float]:
        return stream(seed, name).random(8).tolist()

    here = head(1, "car2/positioning")
    stream(1, "car3/positioning").random(1000)  # draws from another stream have no effect
    assert head(1, "car2/positioning") == here
    others = [head(seed, name) for seed, name in [(2, "car2/positioning"), (1, "car3/positioning"), (1, "car2/positionin")]]
    assert all(not set(here) & set(other) for other in others)


@pytest.mark.parametrize(
    "names", [[f"car{i}" for i in range(100)], [f"radio/car{i}/car{j}" for i in range(30) for j in range(30)]]
)
def test_streams_of_many_names_are_uncorrelated(names: list[str]) -> None:
    first = np.array([stream(7, name).random() for name in names])
    assert abs(first.mean() - 0.5) < 5 / np.sqrt(12 * len(names))
    assert len(set(first.tolist())) == len(names)
    assert len({key64(7, name) for name in names}) == len(names)
