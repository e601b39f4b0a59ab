"""Recognition of targets in pictures from above, by colour, by what turning does not change, and by correlation.

The answer to a call depends on its arguments alone. Vehicles, cameras and maps do not belong here.
"""
