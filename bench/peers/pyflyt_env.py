"""PyFlyt's PettingZoo environment of hovering quadrotors, ``MAQuadXHoverEnv``: ``--agents`` of them, random actions.

``--span_s``: environment steps of a stretch. It has no radio; a step is 1 / 40 s.
"""

from collections.abc import Callable

import numpy as np
from PyFlyt.pz_envs.quadx_envs.ma_quadx_hover_env import MAQuadXHoverEnv  # type: ignore[import-not-found]

from bench.peers.pace import Options, stretches


def environment(settings: Options) -> Callable[[], None]:
    """Reset; each call continues, and resets at the end of an episode."""
    count = settings.agents
    places = np.array([(3.0 * (n % 10), 3.0 * (n // 10), 5.0) for n in range(count)])
    env = MAQuadXHoverEnv(start_pos=places, start_orn=np.zeros((count, 3)), flight_dome_size=1e3)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    actions = {agent: env.action_space(agent) for agent in env.possible_agents}

    def steps() -> None:
        for _ in range(round(settings.span_s)):
            if not env.agents:
                env.reset()
            env.step({agent: _hover(actions[agent], rng) for agent in env.agents})

    return steps


def _hover(space: object, rng: np.random.Generator) -> np.ndarray:
    """Small rates and about the thrust of hovering: random actions would end the episode within a second."""
    low, high = space.low, space.high  # type: ignore[attr-defined]
    action = 0.02 * rng.uniform(low, high)
    action[3] = 0.34 * high[3]
    return np.asarray(action)


if __name__ == "__main__":
    stretches(environment)
