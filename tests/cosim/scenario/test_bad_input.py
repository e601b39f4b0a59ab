"""Bad scenarios through the command line: exit code 2 and one message with the place, the problem, and the allowed values.

``check`` and ``run`` print equal messages and write no file.
"""

from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.command_line import assert_refused, two_cars, vcmvsp_command

pytestmark = pytest.mark.slow


def case(name: str, text: str | bytes, *words: str, sets: tuple[str, ...] = ()) -> Any:
    """A scenario, ``--set`` arguments, and words that the message must contain."""
    return pytest.param(text, sets, words, id=name.replace(" ", "-"))


def case_with_line(name: str, text: str, *words: str) -> Any:
    """A scenario that is refused with the line of the key."""
    return case(name, text, "s.toml line", *words)


def set_case(name: str, setting: str, *words: str, and_set: tuple[str, ...] = ()) -> Any:
    """A good scenario with one bad ``--set``, whose argument the message must contain."""
    key = setting.partition("=")[0]
    return case(name, two_cars(), f"--set {key}", *words, sets=(setting, *and_set))


def check_refused(folder: Path, text: str | bytes, sets: tuple[str, ...], words: tuple[str, ...]) -> None:
    (folder / "s.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    before = sorted(folder.iterdir())
    arguments = [argument for setting in sets for argument in ("--set", setting)]
    check = vcmvsp_command("check", "s.toml", *arguments)
    assert_refused(check, *words)
    assert vcmvsp_command("run", "s.toml", *arguments, "--out", "out") == check
    assert [path for path in sorted(folder.iterdir()) if path.name != "__pycache__"] == before


UNKNOWN = {
    "durations": ("duration_s", two_cars(top="durations = 1")),
    "recrd": ("record", two_cars(tail="[recrd]")),
    "agent": ("agents", two_cars(tail="[agent]")),
    "vehicels": ("vehicles", two_cars(tail="[vehicels]")),
    "physics.gravty": ("gravity", two_cars(physics="gravty = 1")),
    "world.flor_friction": ("floor_friction", two_cars(tail="[world]\nflor_friction = 1")),
    "radio.prest": ("preset", two_cars(tail="[radio]\nprest = 'wss'")),
    "radio.lost": ("loss", two_cars(tail="[radio.lost]\nprobability = 0")),
    "radio.loss.probabilty": ("probability", two_cars(tail="[radio.loss]\nprobabilty = 0")),
    "agents.hroizon_s: this default has no effect": ("horizon_s", two_cars(agents="hroizon_s = 1")),
    "agents.perod_s: this default has no effect": ("period_s", two_cars(agents="perod_s = 1")),
    "vehicles.max_sped: no vehicle has this parameter": ("max_speed", two_cars(tail="[vehicles]\nmax_sped = 1")),
    "vehicle.car2.max_sped": ("max_speed", two_cars(car2="max_sped = 1")),
    "vehicle.car2.pose_sorce": ("pose_source", two_cars(car2="pose_sorce = 'truth'")),
    "vehicle.car2.positioning.rate": ("rate_hz", two_cars(car2="positioning = { rate = 1 }")),
    "vehicle.car2.agent.distanc": ("distance", two_cars(agent="kind='leader_follower', leader='car1', distanc=1")),
    "vehicle.car2.agent.latncy_s": ("latency_s", two_cars(agent="kind='trajectory', latncy_s=1")),
    "record.period": ("period_s", two_cars(tail="[record]\nperiod = 1")),
    "metrics.from": ("from_s", two_cars(tail="[metrics]\nfrom = 1")),
    "world.boxes[0]": ("yaw_rad", two_cars(tail="[world]\nkind='boxes'\nboxes=[{center=[5,5,1], size=[1,1,1], yaw=1}]")),
}
"""By its place: the nearest key to an unknown one, and the scenario with it."""


@pytest.mark.parametrize(("place", "near", "text"), [(place, *case) for place, case in UNKNOWN.items()], ids=UNKNOWN)
def test_an_unknown_key_is_refused_with_the_nearest_and_the_allowed_ones(here: Path, place: str, near: str, text: str) -> None:
    check_refused(here, text, (), ("s.toml line", f": {place}: ", f"did you mean '{near}'?", "allowed: "))


SETTINGS = [
    set_case("set", "radio.loss.probabilty=0.1", "radio.loss.probabilty", "did you mean 'probability'?"),
    set_case("set vehicle", "vehicle.car3.kind=lag", "unknown vehicle 'car3'", "allowed: car1, car2"),
    set_case("set whole vehicle", "vehicle.car2=3", "vehicle.car2"),
    set_case("set in a value", "duration_s.x=1", "'duration_s' is a value, not a table"),
]


WRONG_VALUES = [
    case("string for number", two_cars(top="seed = 'x'"), "s.toml line 4: seed", "a whole number >= 0", "not 'x'"),
    case("boolean for number", two_cars(tail="[metrics]\nfrom_s = true"), "metrics.from_s", "a number >= 0", "not True"),
    set_case("set a list for a table or a list", "bridge.zenoh.listen=[1.0, 2.0]", "bridge.zenoh.listen: must be"),
    case("negative", two_cars(agents="k1 = -0.8"), "s.toml line 9: agents.k1", "a number >= 0", "not -0.8"),
    case("zero period", two_cars(agents="period_s = 0"), "agents.period_s", "a number >= 1e-06", "not 0"),
    case("not finite", two_cars(agents="k1 = inf"), "s.toml line 9: agents.k1", "must be finite, not inf"),
    case("short pose", two_cars().replace("-1.0, -0.5, 0.0", "0, 0"), "vehicle.car2.pose", "a list of 3 values, each a number"),
    case("string pose", two_cars().replace("[-1.0, -0.5, 0.0]", "'here'"), "vehicle.car2.pose", "a list of 3 values"),
    case("choice", two_cars(agent="kind='trajectory', path='sqare'"), "car2.agent.path", "one of 'straight', 'circle'"),
    case("window", two_cars(tail="[metrics]\nfrom_s=3\nto_s=1"), "metrics.to_s", "earlier than metrics.from_s (3), not 1"),
    case_with_line(
        "constructor", two_cars(agent="kind='trajectory', path='straight', yaw_rate=1.0"), "car2.agent", "yaw_rate = 1.0"
    ),
    case_with_line(
        "missing", two_cars(agent="kind='leader_follower'"), "vehicle.car2.agent.leader", "is missing", "the name of a vehicle"
    ),
    case_with_line(
        "box without size", two_cars(tail="[world]\nkind='boxes'\nboxes=[{center=[5,5,1]}]"), "world.boxes[0]: size is missing"
    ),
    case("boxes without boxes", two_cars(tail="[world]\nkind='boxes'"), "world.boxes", "is missing"),
    case_with_line("wheels too heavy", two_cars(car2="mass_kg = 0.1"), "vehicle.car2", "mass_kg = 0.1"),
    case_with_line("no positioning sensor", two_cars(car2="pose_source = 'positioning'"), ": vehicle.car2.pose_source:"),
    case("unknown pose source", two_cars(car2="pose_source = 'gps'"), "car2.pose_source", "'truth', 'odometry', 'positioning'"),
    case("leader unknown", two_cars(agent="kind='leader_follower', leader='car9'"), "car2", "leader", "car9", "car1"),
    case("leader itself", two_cars(agent="kind='leader_follower', leader='car2'"), "car2", "leader", "car1"),
    case_with_line("name with a space", two_cars().replace('"car2"', '"car 2"'), "name", "[A-Za-z0-9_-]", "not 'car 2'"),
    case_with_line("name with a slash", two_cars().replace('"car2"', '"car/2"'), "name", "[A-Za-z0-9_-]"),
    case_with_line("empty name", two_cars().replace('"car2"', '""'), "name", "[A-Za-z0-9_-]"),
    case("number for name", two_cars().replace('"car2"', "2"), "s.toml", "vehicle[1].name", "a string", "not 2"),
    case_with_line("name twice", two_cars().replace('"car2"', '"car1"'), "vehicle.car1.name", "two vehicles are named 'car1'"),
    case("scenario name", two_cars().replace('"two-cars"', '"../x"'), "s.toml line 2: name", "[A-Za-z0-9_-]", "not '../x'"),
    case("no name", two_cars().replace('name = "car2"', ""), "s.toml", "vehicle[1].name", "is missing"),
    case_with_line("no kind", two_cars().replace('kind = "p2dx"\npose', "pose"), "vehicle.car2.kind", "is missing"),
    case_with_line("no agent kind", two_cars(agent="leader='car1'"), "vehicle.car2.agent.kind", "is missing"),
    case("no duration", two_cars().replace("duration_s = 0.5", ""), "s.toml", "duration_s", "is missing", "a number >= 1e-06"),
    case_with_line("all kinds given", two_cars(tail="[vehicles]\nkind='lag'"), "vehicles.kind", "this default has no effect"),
    case_with_line("name for all", two_cars(tail="[vehicles]\nname='lag'"), "vehicles", "set it per vehicle"),
    set_case("set negative", "radio.loss.probability=-0.1", "a number >= 0 and <= 1", "not -0.1"),
    set_case("set a word", "duration_s=long", "a number >= 1e-06", "not 'long'"),
    set_case("set a date", "duration_s=1979-05-27", "a number >= 1e-06", "1979"),
    set_case("set a table", "agents={ period_s = -1 }", "agents.period_s", "a number >= 1e-06", "not -1"),
    set_case("set a table to a value", "radio.loss=0.1", "radio.loss", "must be a table, not 0.1"),
    set_case("set the seed", "seed=-1", "a whole number >= 0", "not -1"),
    set_case("set an estimator", "vehicle.car2.agent.estimator=foo", "unknown estimator 'foo'", "dr, hold"),
    set_case("set two values", "duration_s=1\nseed=3", "duration_s"),
]


BULLET = ("physics.kind=bullet",)
TIMES = [
    set_case("agents period", "agents.period_s=0.013", "0.013", "1/120", "rate_hz", and_set=BULLET),
    set_case("agent period", "vehicle.car2.agent.period_s=0.013", "0.013", "1/120", "rate_hz", and_set=BULLET),
    set_case("latency", "agents.latency_s=0.013", "0.013", "1/120", "rate_hz", and_set=BULLET),
    set_case("record period", "record.period_s=0.013", "0.013", "1/120", "rate_hz", and_set=BULLET),
    set_case("positioning rate", "vehicle.car2.positioning.rate_hz=7", "0.142857", "1/120", "rate_hz", and_set=BULLET),
    set_case("duration", "duration_s=0.501", "0.501", "1/120", and_set=BULLET),
    set_case("tiny agents period", "agents.period_s=1e-12", "must be a number >= 1e-06"),
    set_case("tiny record period", "record.period_s=1e-12", "must be a number >= 1e-06"),
    set_case("tiny positioning period", "vehicle.car2.positioning.rate_hz=1e12", "must be a number >= 1e-06"),
    set_case("tiny physics period", "physics.rate_hz=1e12", "must be a number >= 1e-06", and_set=BULLET),
    set_case("tiny duration", "duration_s=1e-12", "must be a number >= 1e-06"),
    set_case("huge agents period", "agents.period_s=1e300", "agents.period_s"),
    set_case("huge delay", "radio.delay.seconds=1e10", "radio.delay.seconds"),
    set_case("huge jitter", "radio.delay.jitter_s=1e300", "radio.delay.jitter_s"),
    set_case("huge overhead", "radio.phy.overhead_s=1e300", "radio.phy.overhead_s"),
    set_case("huge seed", "seed=" + "9" * 30, "seed"),
]


@pytest.mark.parametrize(
    ("x", "tail"), [("0.1", ""), ("-3.0", "[world]\nkind='boxes'\nboxes=[{center=[-3,-0.5,0.5], size=[1,1,1]}]")]
)
def test_bodies_that_overlap_at_the_start_are_refused(here: Path, x: str, tail: str) -> None:
    text = two_cars(tail=tail).replace("-1.0, -0.5", f"{x}, -0.5" if tail else f"{x}, 0.1")
    check_refused(here, text, BULLET, ("vehicle.car2.pose", "car2", "overlap", "at the start"))


KINDS = [
    ("physics.kind", "bulet", "bullet"),
    ("world.kind", "emty", "empty"),
    ("radio.preset", "wifi-b-1l", "wifi-b-1"),
    ("radio.path_loss.kind", "log_distanc", "log_distance"),
    ("radio.phy.kind", "dss", "dsss"),
    ("radio.loss.kind", "bernouli", "bernoulli"),
    ("radio.delay.kind", "fixd", "fixed"),
    ("vehicle.car2.kind", "p2dxx", "p2dx"),
    ("vehicle.car2.agent.kind", "leader_folower", "leader_follower"),
]


@pytest.mark.parametrize(("key", "wrong", "right"), KINDS, ids=lambda word: word)
def test_an_unknown_kind_is_refused_with_the_nearest(here: Path, key: str, wrong: str, right: str) -> None:
    words = (f"vcmvsp: --set {key}={wrong}: {key}: unknown", f"'{wrong}'", f"did you mean '{right}'?", "allowed: ")
    check_refused(here, two_cars(), (f"{key}={wrong}",), words)


@pytest.mark.parametrize("key", [key for key, _, _ in KINDS] + ["agents.runs", "vehicle.car2.pose_source"])
def test_a_kind_that_is_no_string_is_refused(here: Path, key: str) -> None:
    check_refused(here, two_cars(), (f"{key}=3",), (f"--set {key}=3: {key}: ",))


@pytest.mark.parametrize("section", ["physics", "world", "radio", "agents", "vehicles", "record", "metrics"])
@pytest.mark.parametrize("form", ["array", "value"])
def test_a_table_must_be_a_table(here: Path, section: str, form: str) -> None:
    plain = two_cars().replace('[physics]\nkind = "kinematic"\n', "").replace("[agents]\n", "")
    text = f"{plain}\n[[{section}]]\n" if form == "array" else f"{section} = 3\n{plain}"
    several = " radio[0].name: is missing"  # radios may be a list of tables
    words = several if (section, form) == ("radio", "array") else f" {section}: must be a table, not "
    check_refused(here, text, (), ("s.toml line", words))


WITHOUT = two_cars().partition("[[vehicle]]")[0]
SHAPES = [
    case("vehicle is one table", WITHOUT + "[vehicle]\nname='car1'", "s.toml", "vehicle: needs at least one [[vehicle]]"),
    case("vehicle is a list of numbers", "vehicle = [3]\n" + WITHOUT, "s.toml", "vehicle[0]: must be a table, not 3"),
    case("vehicle is a number", "vehicle = 3\n" + WITHOUT, "s.toml", "needs at least one [[vehicle]]"),
    case("vehicle is an empty list", "vehicle = []\n" + WITHOUT, "s.toml", "needs at least one [[vehicle]]"),
    case("set in a vehicle that is a number", "vehicle = 3\n" + WITHOUT, "vehicle", sets=("vehicle.car1.kind=lag",)),
    case("no vehicle", WITHOUT, "s.toml", "needs at least one [[vehicle]]"),
    case("empty", "", "s.toml", "needs at least one [[vehicle]]"),
    case_with_line("layer is a list", two_cars(tail="[[radio.loss]]\nkind='none'"), "radio.loss: must be a table"),
    set_case("set an agent to a number", "vehicle.car2.agent=3", "vehicle.car2.agent: must be a table"),
    case_with_line("positioning is a number", two_cars(car2="positioning = 3"), "vehicle.car2.positioning", "a table"),
    case("not TOML", "name = \n", "s.toml", "is not valid TOML", "line 1"),
    case("key twice", "name = 'a'\nname = 'b'\n", "s.toml", "is not valid TOML", "line 2"),
    case("not UTF-8", b"name = '\xff'\n", "s.toml", "UTF-8"),
    case("binary", bytes(range(256)), "s.toml", "UTF-8"),
]


@pytest.mark.parametrize(("text", "sets", "words"), [*SETTINGS, *WRONG_VALUES, *TIMES, *SHAPES])
def test_a_scenario_is_refused(here: Path, text: str | bytes, sets: tuple[str, ...], words: tuple[str, ...]) -> None:
    check_refused(here, text, sets, words)


AGENTS = '''
from vcmvsp import Agent
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower

class Picky(Agent):
    def __init__(self, n: int = 1) -> None:
        raise ValueError("n = 1 is not my number")
    def act(self, obs, radio): ...
class Broken(Agent):
    def __init__(self) -> None:
        self.x = {}.nothing
    def act(self, obs, radio): ...
class Leaving(Agent):
    def __init__(self) -> None:
        raise SystemExit(3)
    def act(self, obs, radio): ...
class Hasty(Agent):
    period = -1.0
    def act(self, obs, radio): ...
class Mine(LeaderFollower):
    """Its constructor is the base class's."""
class Mute: ...
class Unfinished(Agent): ...
nothing = 3
'''


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("imports.py:A", ("No module named 'no_such_thing'", "imports.py line 3")),
        ("mine.py:", ("has no class ''",)),
        ("mine.py", ("unknown agent kind 'mine.py'", "module:Class or file.py:Class")),
        ("mine.py:Mute", ("'mine.py:Mute' is not an agent", "act(obs, radio)")),
        ("mine.py:nothing", ("is not an agent", "act(obs, radio)")),
        ("mine.py:Unfinished", ("act",)),
        ("mine.py:Picky", ("n = 1 is not my number",)),
        ("mine.py:Broken", ("mine.py line 11", "AttributeError")),
        ("mine.py:Leaving", ("SystemExit",)),
        ("mine.py:Hasty", ("period",)),
    ],
)
def test_a_class_that_cannot_be_an_agent_is_refused(here: Path, kind: str, words: tuple[str, ...]) -> None:
    (here / "mine.py").write_text(AGENTS)
    (here / "imports.py").write_text("\n\nimport no_such_thing\n")
    key = "vehicle.car2.agent.kind"
    check_refused(here, two_cars(agent="kind='trajectory'"), (f"{key}={kind}",), (f"--set {key}", *words))


def test_an_inherited_constructor_is_checked(here: Path) -> None:
    (here / "mine.py").write_text(AGENTS)
    text = two_cars(agent="kind='mine.py:Mine', leader='car1'")
    check_refused(here, text, ("vehicle.car2.agent.distance=far",), ("--set vehicle.car2.agent.distance", "a number > 0"))


@pytest.mark.parametrize(
    ("key", "kind", "word"),
    [
        ("vehicle.car2.kind", "json:JSONDecoder", "vehicle"),
        ("radio.loss.kind", "json:JSONDecoder", "lost"),
        ("radio.loss.kind", "math:pi", "math:pi"),
    ],
)
def test_a_class_of_another_part_is_refused(here: Path, key: str, kind: str, word: str) -> None:
    check_refused(here, two_cars(), (f"{key}={kind}",), (f"--set {key}", word))


def test_a_constructor_that_refuses_is_reported_with_its_table(here: Path) -> None:
    (here / "mine.py").write_text(AGENTS)
    check_refused(
        here, two_cars(agent="kind='mine.py:Picky'"), (), ("s.toml line", "vehicle.car2.agent", "n = 1 is not my number")
    )


@pytest.mark.parametrize("setting", ["foo", "=1", " =1", ""])
def test_a_setting_without_a_key_or_an_equals_sign_is_refused(here: Path, setting: str) -> None:
    check_refused(here, two_cars(), (setting,), (f"--set {setting}", "KEY=VALUE"))


@pytest.mark.parametrize("setting", [".=1", "radio..x=1", "vehicle..x=1"])
def test_a_setting_with_an_empty_part_of_a_key_is_refused(here: Path, setting: str) -> None:
    check_refused(here, two_cars(), (setting,), ("unknown",))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("formation-circl", ("unknown scenario", "did you mean 'formation-circle'?", ".toml")),
        ("nix.toml", ("nix.toml", "there is no such file")),
        ("no/nix", ("no/nix", "there is no such file")),
        ("", ("unknown scenario ''",)),
        ("folder", ("folder",)),
        ("./folder", ("./folder", "is a folder, not a scenario file")),
        ("folder.toml", ("folder.toml", "is a folder, not a scenario file")),
    ],
)
def test_a_missing_scenario_is_refused(here: Path, name: str, words: tuple[str, ...]) -> None:
    (here / "folder").mkdir()
    (here / "folder.toml").mkdir()
    outcome = vcmvsp_command("check", name)
    assert_refused(outcome, *words)
    for arguments in (("run", name, "--out", "out"), ("run", name), ("show", name)):
        assert vcmvsp_command(*arguments) == outcome
    assert sorted(path.name for path in here.iterdir()) == ["folder", "folder.toml"]
