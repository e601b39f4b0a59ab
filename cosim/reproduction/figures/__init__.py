"""Figures of Toh 2012 and further studies, redrawn from runs of the whole platform and compared with what must come out.

``vcmvsp figure NAME`` makes one. Models, laws and agents that a scenario could name do not belong here.

Start reading in `cosim.reproduction.figures.figure`.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import UsageError

if TYPE_CHECKING:
    from vcmvsp.cosim.reproduction.figures.figure import Figure
    from vcmvsp.cosim.reproduction.runner import Runner

NAMES: Mapping[str, tuple[str, str]] = {
    "24": ("formation.circle:fig_24", "Leader-follower triangle on a circle; proof of convergence."),
    "25": ("formation.circle:fig_25", "The triangle on a circle, inertial vehicles."),
    "26": ("formation.circle:fig_26", "The triangle on a circle, noise of positioning."),
    "28": ("avoidance.potential_fields:fig_28", "Potential field: one vehicle past a pillar."),
    "29": ("avoidance.potential_fields:fig_29", "Potential field: a triangle past a pillar; how near members may be."),
    "30": ("formation.steps:fig_30", "Step along the heading, for five gains k1."),
    "31": ("formation.steps:fig_31", "Step across the heading, for five gains k2."),
    "32": ("formation.steps:fig_32", "A leader that starts at once: inertia delays its followers."),
    "33": ("formation.steps:fig_33", "Rates of control from 10 to 0.5 Hz, and the bound on k2."),
    "41": ("avoidance.gaps:fig_41", "A follower before a wall with doors: which it takes, and how wide they are."),
    "42": ("avoidance.passages:fig_42", "A corridor, wide again as soon as the leader is out."),
    "43": ("avoidance.passages:fig_43", "A corridor, wide again when all are clear."),
    "45": ("search.map_exchange:fig_45", "The shared map of two that search, at four instants."),
    "46": ("search.recognition_stages:fig_46", "Recognition, first stage: where the target's colours are."),
    "47": ("search.recognition_stages:fig_47", "Recognition, later stages: turned and shifted targets; likenesses."),
    "51": ("search.reconnaissance:fig_51", "Two quadrotors find and track two targets in a town."),
    "54": ("avoidance.laboratory:fig_54", "A team among the furniture of a laboratory."),
    "loss": ("formation.messages:loss", "Formation error by loss of messages: hold, dr, acc, plan."),
    "delay": ("formation.messages:delay", "Formation error by delay of messages: closed forms, hold and dr."),
    "loss-delay": ("formation.messages:loss_delay", "Loss and delay together: maps of hold and dr."),
    "estimators": ("formation.messages:estimators", "Formation error by delay: hold, dr, acc, plan."),
    "chain": ("formation.chain:chain", "A column of seven: gain from hop to hop, and what cures it."),
    "consensus-delay": ("formation.consensus:consensus_delay", "Consensus with delay: the last that is stable, four graphs."),
    "stall": ("avoidance.potential_fields:stall", "Potential field: a pillar on the way to the goal, and the way out."),
    "levels": ("avoidance.speed_limits:fig_levels", "Past a pillar at 1 to 3 m/s: a second level of avoidance."),
    "passage-policies": ("avoidance.passages:passage_policies", "Three rules of when a team is wide again, in three worlds."),
    "search-exchange": ("search.map_exchange:search_exchange", "Time of a search by exchange of maps and loss."),
    "recognition": ("search.recognition:recognition", "Targets recognised from 10 to 40 m, by one to three stages."),
}
"""Name -> module:function in this package, and what it shows."""


def find(name: str) -> "Callable[[Runner], Figure]":
    """The function that makes a figure.

    Raises:
        UsageError: there is none of that name.
    """
    if name not in NAMES:
        raise UsageError(f"vcmvsp figure {name}: {unknown('figure', name, NAMES)}")
    module, _, function = NAMES[name][0].partition(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), function)
