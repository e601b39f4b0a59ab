"""The probability map of a search: cells, sensor evidence, decisions, cells in a picture."""

from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor, decisions
from vcmvsp.agents.reconnaissance.search_map import of_picture

__all__ = ["Grid", "Rectangle", "Sensor", "decisions", "of_picture"]
