"""From a TOML table to a checked call: values accepted, values refused with their messages, and sources of defaults."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Count, Name, NonNegative, Positive, Probability


class Rain:
    """A target with all types of parameters."""

    def __init__(
        self,
        db_per_km: NonNegative,
        *,
        seed: Count = 0,
        size: Positive | None = None,
        heavy: bool = False,
        places: tuple[tuple[float, float], ...] = (),
        season: Literal["wet", "dry"] = "wet",
    ) -> None:
        self.content: tuple[Any, ...] = (db_per_km, seed, size, heavy, places, season)


class Lines(Source):
    """A source whose line is the requested key."""

    def of(self, key: str) -> str:
        return f"<{key}>"


def refusal(values: dict[str, Any], target: Any = Rain, **options: Any) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        binding.call(target, values, key="radio.rain", origin=Lines(), **options)
    return caught.value


def test_values_are_converted_and_defaults_are_in_the_signature() -> None:
    assert binding.call(Rain, {"db_per_km": 2}).content == (2.0, 0, None, False, (), "wet")
    full = {"db_per_km": 2.5, "seed": 3, "size": 1.0, "heavy": True, "places": [[1, 2], [3.5, 4]], "season": "dry"}
    assert binding.call(Rain, full).content == (2.5, 3, 1.0, True, ((1.0, 2.0), (3.5, 4.0)), "dry")
    assert isinstance(binding.call(Rain, {"db_per_km": 2}).content[0], float)


@pytest.mark.parametrize(
    ("values", "key", "words"),
    [
        (
            {"db_per_km": 1, "heavi": True},
            "heavi",
            ["unknown key 'heavi'", "did you mean 'heavy'?", "allowed: db_per_km, heavy"],
        ),
        ({}, "db_per_km", ["is missing", "a number >= 0"]),
        ({"db_per_km": -1}, "db_per_km", ["must be a number >= 0", "not -1"]),
        ({"db_per_km": "much"}, "db_per_km", ["must be a number >= 0", "not 'much'"]),
        ({"db_per_km": True}, "db_per_km", ["must be a number", "not True"]),
        ({"db_per_km": math.nan}, "db_per_km", ["must be finite", "nan"]),
        ({"db_per_km": -math.inf}, "db_per_km", ["must be finite", "-inf"]),
        ({"db_per_km": 1, "seed": 1.5}, "seed", ["must be a whole number >= 0", "not 1.5"]),
        ({"db_per_km": 1, "seed": -1}, "seed", ["must be a whole number >= 0", "not -1"]),
        ({"db_per_km": 1, "size": 0}, "size", ["must be a number > 0", "not 0"]),
        ({"db_per_km": 1, "heavy": 1}, "heavy", ["must be true or false", "not 1"]),
        ({"db_per_km": 1, "heavy": "true"}, "heavy", ["must be true or false", "not 'true'"]),
        ({"db_per_km": 1, "places": [[1]]}, "places", ["a list, each item a list of 2 values, each a number"]),
        ({"db_per_km": 1, "places": [[1, math.nan]]}, "places", ["must be finite, not nan"]),
        ({"db_per_km": 1, "season": "hot"}, "season", ["must be one of 'wet', 'dry'", "not 'hot'"]),
        ({"db_per_km": 1, "places": list(range(500))}, "places", ["..."]),
    ],
)
def test_a_refusal_names_the_key_the_value_and_allowed_ones(values: dict[str, Any], key: str, words: list[str]) -> None:
    error = refusal(values)
    assert error.key == f"radio.rain.{key}"
    assert error.source in (f"<radio.rain.{key}>", "<radio.rain>")  # a missing key has no line, its table has one
    assert str(error) == f"{error.source}: {error.key}: {error.problem}"
    assert all(word in error.problem for word in words), error.problem
    assert len(error.problem) < 250


class Drop(msgspec.Struct, forbid_unknown_fields=True):
    """A table in a list."""

    size_mm: Positive
    place: tuple[float, float] = (0.0, 0.0)


@pytest.mark.parametrize(
    ("drop", "key", "words"),
    [
        ({"size_mm": 0}, "drops[1].size_mm", "must be a number > 0, not 0"),
        ({"place": [1, 1]}, "drops[1]", "size_mm is missing; it must be a number > 0"),
        ({"size_mm": 1, "plac": 1}, "drops[1]", "unknown key 'plac'; did you mean 'place'? (allowed: place, size_mm)"),
        ({"size_mm": 1, "place": [1, "x"]}, "drops[1].place[1]", "must be a number, not 'x'"),
        (3, "drops[1]", "must be a table, not 3"),
    ],
)
def test_a_refusal_inside_a_list_of_tables_names_the_item(drop: Any, key: str, words: str) -> None:
    def shower(drops: tuple[Drop, ...]) -> None: ...

    error = refusal({"drops": [{"size_mm": 1.0}, drop]}, shower)
    assert error.key == f"radio.rain.{key}"
    assert words in error.problem


def test_arguments_of_the_program_are_no_keys() -> None:
    assert binding.call(Rain, {}, arguments={"db_per_km": "anything"}).content == ("anything", 0, None, False, (), "wet")
    assert "unknown key 'db_per_km'" in refusal({"db_per_km": 1}, arguments={"db_per_km": 2}).problem


@pytest.mark.parametrize(
    ("problem", "key"),
    [
        ("this is beyond all scales", "radio.rain"),
        ("force 13 is beyond all scales", "radio.rain.force"),
        ("forceful", "radio.rain"),
        ("force and wind do not go together", "radio.rain"),
        ("it takes more force than there is", "radio.rain"),
        ("beyond all scales: force = 13", "radio.rain.force"),
        ("beyond all scales: 'force'", "radio.rain.force"),
    ],
)
def test_a_value_error_of_the_target_names_the_table_or_the_one_key_that_it_mentions(problem: str, key: str) -> None:
    def storm(force: int, wind: int) -> None:
        raise ValueError(problem)

    error = refusal({"force": 13, "wind": 1}, storm)
    assert (error.key, error.problem) == (key, problem)


@pytest.mark.parametrize("name", ["line", "storm"])
def test_the_place_of_an_error_is_no_mention_of_a_parameter(name: str) -> None:
    def storm(line: int = 0, storm: int = 0) -> None:
        raise TypeError("this is beyond all scales")

    error = refusal({name: 13}, storm)
    assert (error.key, error.problem.partition(":")[0]) == ("radio.rain", "storm raised TypeError")


@pytest.mark.parametrize(
    ("key", "source", "place"),
    [
        ("force", "", "<radio.rain.force>: radio.rain.force"),
        ("wind.force", "storm.toml line 3", "storm.toml line 3: wind.force"),
    ],
)
def test_a_scenario_error_of_the_target_is_placed_in_its_table_unless_it_is_placed(key: str, source: str, place: str) -> None:
    def storm(force: int) -> None:
        raise ScenarioError("is beyond all scales", key=key, source=source)

    assert str(refusal({"force": 13}, storm)) == f"{place}: is beyond all scales"


@dataclass(frozen=True, kw_only=True)
class Data:
    """A frozen dataclass."""

    probability: Probability
    name: Name = "x"


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """A msgspec struct."""

    probability: Probability
    name: Name = "x"


def function(*, probability: Probability, name: Name = "x") -> tuple[float, str]:
    """A function."""
    return probability, name


@pytest.mark.parametrize("target", [Data, Record, function])
def test_classes_structs_and_functions_are_called_alike(target: Any) -> None:
    built = binding.call(target, {"probability": 1})
    assert built in (Data(probability=1.0), Record(probability=1.0), (1.0, "x"))
    assert "a number >= 0 and <= 1" in refusal({"probability": 2}, target).problem
    assert "is missing" in refusal({}, target).problem
    assert "matching" in refusal({"probability": 0, "name": "a/b"}, target).problem
    assert binding.complete(target, {"probability": 0}) == {"probability": 0.0, "name": "x"}


def test_without_annotation_any_finite_value_is_accepted() -> None:
    def free(a, b=3):  # type: ignore[no-untyped-def]  # as somebody's own agent may be written
        return a, b

    assert binding.call(free, {"a": {"x": [1]}, "b": "y"}) == ({"x": [1]}, "y")
    assert "must be finite" in refusal({"a": {"x": [math.inf]}}, free).problem


def test_annotations_that_cannot_be_read_do_not_matter() -> None:
    class Odd:
        def __init__(self, a: "NoSuchName", b: int = 1) -> None:  # type: ignore[name-defined]  # noqa: F821
            self.content = (a, b)

    assert binding.call(Odd, {"a": 1}).content == (1, 1)


def test_an_inherited_constructor_is_checked_too() -> None:
    class Drizzle(Rain):
        """Its constructor is the base class's."""

    assert "must be a number >= 0" in refusal({"db_per_km": -1}, Drizzle).problem


def test_star_arguments_are_no_keys() -> None:
    def greedy(a: int, *args: int, **rest: int) -> int:
        return a

    assert binding.call(greedy, {"a": 1}) == 1
    assert "unknown key 'args'" in refusal({"a": 1, "args": [1]}, greedy).problem
    assert "unknown key 'x'" in refusal({"a": 1, "x": 1}, greedy).problem


VALUES = st.fixed_dictionaries(
    {"db_per_km": st.integers(0, 5) | st.floats(0, 5)},
    optional={
        "seed": st.integers(0, 9),
        "size": st.floats(0.1, 5),
        "heavy": st.booleans(),
        "places": st.lists(st.lists(st.floats(-1, 1), min_size=2, max_size=2), max_size=3),
        "season": st.sampled_from(["wet", "dry"]),
    },
)


@given(VALUES)
def test_a_completed_table_means_the_same_and_is_complete(values: dict[str, Any]) -> None:
    full = binding.complete(Rain, values)
    assert set(values) <= set(full) <= set(binding.parameters(Rain))
    assert {"seed", "heavy", "places", "season"} <= set(full)
    assert binding.call(Rain, full).content == binding.call(Rain, values).content
    assert binding.complete(Rain, full) == full


def test_complete_omits_values_without_toml_form() -> None:
    def odd(a: int = 1, b: float | None = None, c: Any = object(), d: dict[str, Any] = {"x": None, "y": 2}) -> None: ...  # noqa: B006, B008

    assert binding.complete(odd, {}) == {"a": 1, "d": {"y": 2}}
    assert binding.complete(odd, {"a": 2}, without=["d"]) == {"a": 2}


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (float, "a number"),
        (int, "a whole number"),
        (str, "a string"),
        (bool, "true or false"),
        (Positive, "a number > 0"),
        (Probability, "a number >= 0 and <= 1"),
        (Annotated[int, msgspec.Meta(ge=1)], "a whole number >= 1"),
        (Positive | None, "a number > 0"),
        (float | str, "a number or a string"),
        (Literal["a", "b"], "one of 'a', 'b'"),
        (tuple[float, float, float], "a list of 3 values, each a number"),
        (tuple[str, int], "a list of 2 values, each a string / a whole number"),
        (list[int], "a list, each item a whole number"),
        (tuple[int, ...], "a list, each item a whole number"),
        (dict[str, Any], "a table"),
        (dict, "a table"),
    ],
)
def test_annotations_in_words(annotation: Any, words: str) -> None:
    assert binding.describe(annotation) == words


@pytest.mark.parametrize(
    ("value", "bad"),
    [
        (1.0, None),
        (math.inf, math.inf),
        ("nan", None),
        ({"a": [1, {"b": -math.inf}]}, -math.inf),
        ([True, 3, None], None),
        ([2**63, 2**64], 2**64),
    ],
)
def test_unfit_numbers(value: Any, bad: float | None) -> None:
    assert binding.unfit_number(value) == bad


def test_suggestions_are_near_and_lists_are_sorted() -> None:
    assert binding.unknown("key", "probabilty", ["rate", "probability"]) == (
        "unknown key 'probabilty'; did you mean 'probability'? (allowed: probability, rate)"
    )
    assert binding.unknown("key", "zzz", ["b", "a"]) == "unknown key 'zzz' (allowed: a, b)"
    assert binding.unknown("key", "zzz", []) == "unknown key 'zzz' (allowed: none)"


class Base:
    """One parameter."""

    def __init__(self, *, one: Positive = 1.0) -> None:
        self.one = one


class Derived(Base):
    """Own parameter ``two``; the rest goes to the base class."""

    def __init__(self, two: int, **more: Any) -> None:
        super().__init__(**more)
        self.two = two


def test_forwarded_keywords_are_parameters_of_the_base() -> None:
    assert list(binding.parameters(Derived)) == ["two", "one"]
    made = binding.call(Derived, {"two": 2, "one": 3.0})
    assert (made.two, made.one) == (2, 3.0)
    with pytest.raises(ScenarioError, match="one: must be a number > 0, not -1"):
        binding.call(Derived, {"two": 2, "one": -1})
    with pytest.raises(ScenarioError, match=r"unknown key 'more'.*\(allowed: one, two\)"):
        binding.call(Derived, {"two": 2, "more": {}})


class Near(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="near"):
    """One of two kinds of table."""

    distance: Positive = 1.0

    def __post_init__(self) -> None:
        if self.distance > 10.0:
            raise ValueError("distance must be near")


class Far(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="far"):
    """The other kind."""

    height: float = 0.0


class Nested(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table with an inner table."""

    near: Near | None = None
    steps: tuple[tuple[float, Literal["up", "down"]], ...] = ()


@pytest.mark.parametrize(
    ("kind", "value", "problem"),
    [
        (Near | Far, {}, "at: kind is missing; it must be one of 'near', 'far'"),
        (Near | Far, {"kind": "fat"}, "at.kind: must be one of 'near', 'far', not 'fat'; did you mean 'far'?"),
        (Near | Far, {"kind": "near", "height": 1.0}, "at: unknown key 'height' (allowed: distance, kind)"),
        (Near | Far, {"kind": "near", "distance": -1.0}, "at.distance: must be a number > 0, not -1.0"),
        (Near | Far, {"kind": "near", "distance": 11.0}, "at: distance must be near"),
        (Nested, {"near": {"kind": "near", "distanze": 1}}, "at.near: unknown key 'distanze'; did you mean 'distance'?"),
        (Nested, {"near": {"kind": "near", "distance": 0}}, "at.near.distance: must be a number > 0, not 0"),
        (Nested, {"near": "by"}, "at.near: must be a table with its kind, not 'by'"),
        (Nested, {"steps": [[1, "dawn"]]}, "at.steps[0][1]: must be one of 'up', 'down', not 'dawn'; did you mean 'down'?"),
        (Nested, {"steps": [["x", "up"]]}, "at.steps[0][0]: must be a number, not 'x'"),
    ],
)
def test_an_error_names_the_innermost_table_of_the_right_kind(kind: Any, value: dict[str, Any], problem: str) -> None:
    assert binding.convert({"kind": "far", "height": 2}, Near | Far | None) == Far(2.0)
    with pytest.raises(ScenarioError) as caught:
        binding.convert(value, kind | None, key="at")
    assert str(caught.value).startswith(problem)


def test_a_table_of_another_kind_loses_keys_of_the_former() -> None:
    value = {"kind": "near", "height": 3.0, "distance": 2.0}
    assert binding.fitted(value, Near | Far | None, ()) == {"kind": "near", "distance": 2.0}
    assert binding.fitted(value, Near | Far | None, ("kind", "height")) == value  # requested explicitly: kept, to be refused
    assert binding.fitted({"kind": "fat", "height": 3.0}, Near | Far, ()) == {"kind": "fat", "height": 3.0}
    assert binding.fitted("near", Near | Far, ()) == "near"
