"""Searching an area together: a map of where targets may be, ways to share it over a radio, and the division of the area.

`probability_map`: cells, sensors and Bayes' rule; `exchange`: four ways to share the map; `sectors`: strips and lanes; `watch`:
the camera, and what is recognised in its pictures; `track`: keeping over a target. No formation or avoidance belongs here.
"""
