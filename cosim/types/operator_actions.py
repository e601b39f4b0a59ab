"""What an operator does to a run."""

from vcmvsp.cosim.types.quantities import Value


class Outage(Value, frozen=True, kw_only=True, tag="outage"):
    """The operator has all frames from and to these vehicles lost."""

    vehicles: tuple[str, ...]
    until_ns: int


class Changed(Value, frozen=True, kw_only=True, tag="changed"):
    """The operator has given a key of the scenario another value."""

    key: str
    value: float


class Moved(Value, frozen=True, kw_only=True, tag="moved"):
    """The operator has put an obstacle somewhere else, where it rests."""

    obstacle: str
    position: tuple[float, float]  # m, world
    yaw: float  # rad


class Halted(Value, frozen=True, kw_only=True, tag="halted"):
    """The operator has vehicles stand still, whatever their agents command, or lets them go on."""

    vehicles: tuple[str, ...]
    halted: bool
