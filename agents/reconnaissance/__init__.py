"""Searching an area together: a map of where targets may be, ways to share it over a radio, and the division of the area.

`probability_map`: cells, sensors and Bayes' rule; `exchange`: four ways to share the map, `ledger` the one that survives loss;
`sectors`: strips and lanes. `watch`: the camera, and what is recognised in its pictures; `track`: keeping over a target.
Formations and obstacle avoidance do not belong here.
"""

from vcmvsp.agents.reconnaissance.exchange import MapExchange, exchange
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor, decisions, log_odds, probability
from vcmvsp.agents.reconnaissance.sectors import Comb, lanes, strips

__all__ = [
    "Comb",
    "Grid",
    "MapExchange",
    "Rectangle",
    "Sensor",
    "decisions",
    "exchange",
    "lanes",
    "log_odds",
    "probability",
    "strips",
]
