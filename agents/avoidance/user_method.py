"""A method of one's own, by the name of its class.

::

    class Stop:
        def __init__(self, body, distance: float = 0.5):
            self.distance = distance + body.radius_m

        def decide(self, view, task):
            if view.nearest_m < self.distance:
                return Decision((0.0, 0.0), 0.0, "avoid")
            return Decision(task.velocity, task.yaw_rate, "task")

    avoidance = { kind = "own", algorithm = "stop.py:Stop", params = { distance = 0.3 } }
"""

from collections.abc import Callable
from typing import Any

import msgspec

from vcmvsp.agents.avoidance.method import Method
from vcmvsp.agents.avoidance.settings import Settings
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.config.binding import call, parameters
from vcmvsp.cosim.config.registry import find
from vcmvsp.cosim.types import Positive


class Own(Settings, frozen=True, kw_only=True, tag="own"):
    """A method of one's own."""

    algorithm: str  # module:Class or file.py:Class with a method decide(view, task)
    params: dict[str, Any] = msgspec.field(default_factory=dict)  # of its constructor; body and period_s come by themselves
    reach: Positive = 1.2  # m: what is nearer counts as an obstacle, in what is recorded

    @property
    def reach_m(self) -> float:
        """As it is set."""
        return self.reach

    def maker(self) -> Callable[[Body, float], Method]:
        """Looks the class up at once, while it is known where its file is looked for."""
        factory = find("avoidance", self.algorithm, key="avoidance.algorithm")

        def make(body: Body, period_s: float) -> Method:
            offered = {"body": body, "period_s": period_s}
            params = {name: value for name, value in offered.items() if name in parameters(factory)}
            method: Method = call(factory, self.params, key="avoidance.params", given=params)
            return method

        return make
