"""Names of the built-in tasks for ``gymnasium.make``.

``import vcmvsp.env`` registers them, as does ``gymnasium.make("vcmvsp.env:vcmvsp/formation-v0")`` by itself: Gymnasium 1.0 and
newer load no entry points. Other programs find `register` by the entry point ``gymnasium.envs``.
"""

import gymnasium

from vcmvsp.cosim.learning.tasks import TASKS


def register() -> None:
    """Register ``vcmvsp/formation-v0``, ``vcmvsp/search-v0`` and ``vcmvsp/gates-v0``, unless they are known."""
    for task in TASKS:
        name = f"vcmvsp/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point="vcmvsp.cosim.learning.single_env:VehicleEnv", kwargs={"task": task})
