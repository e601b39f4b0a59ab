"""Figures of runs, studies, missions and calibrations as PNG and SVG."""
